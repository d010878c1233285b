"""Rows in which nothing is injected: the walk itself asks for more than is allowed."""

from __future__ import annotations

import time
from typing import Final

from fes.hil.campaign_bench import LATCHED, CampaignBench, badly_named, named_now
from fes.hil.judge import MS, length_ms, resumed_after, with_late_pulses
from fes.hil.results import Attempt
from fes.hil.scenarios import Scenario
from fes.hil.settings import DOSE_MC
from fes.signals import NS_PER_S

STUCK_MS: Final = 1500.0  # on for so long, the burst is none of walking
DOSE_WAIT_S: Final = 60.0
DOSE_TRIES: Final = 4
DOSE_ROUNDING_UC: Final = 12.0  # one command's and one pulse's charge


def burst_without_end(rig: CampaignBench, scenario: Scenario) -> Attempt:
    """A stance that does not end: the burst must, at its longest on-time."""
    rig.prepare(scenario.variant)
    burst = rig.in_burst(STUCK_MS)
    rig.watch((scenario.deadline_ms or 0.0) * 1e-3 - 1e-3 * STUCK_MS + 0.3)
    named = named_now(rig)
    stretches = rig.outputs(burst.on_ns)
    first = next(output for output in stretches if output.on_ns == burst.on_ns)
    longest = with_late_pulses(stretches, first)
    faults = badly_named(named, scenario)
    if resumed_after(stretches, burst.on_ns):
        faults.append("current again without arming")
    last_ms = (longest[-1].last_pulse_ns - burst.on_ns) / MS
    return Attempt(length_ms(longest, time.monotonic_ns()), last_ms, named, tuple(faults))


def charge_without_end(rig: CampaignBench, scenario: Scenario) -> Attempt:
    """Step after step: the charge of a minute must end it, and not a moment later."""
    begin_ns = time.monotonic_ns()
    rig.prepare(scenario.variant)
    for _ in range(DOSE_TRIES):
        rig.until(lambda status: status.state in LATCHED, None, DOSE_WAIT_S, "the charge is not capped")
        named, now_ns = named_now(rig), time.monotonic_ns()
        if not badly_named(named, scenario) or not rig.was_away(named, now_ns - NS_PER_S, now_ns):
            break
        rig.away.append(named)  # not what is asked here; its charge still counts
        rig.arm()
    rig.watch(scenario.watch_s)
    charge_uc = sum(output.charge_uc for output in rig.outputs(begin_ns) if output.on_ns >= begin_ns)
    faults = badly_named(named, scenario)
    if not 0.0 < charge_uc <= 1e3 * DOSE_MC + DOSE_ROUNDING_UC:
        faults.append(f"{charge_uc:.0f} µC delivered, limit {1e3 * DOSE_MC:.0f} µC")
    return Attempt(named=named, faults=tuple(faults), remark=f"{charge_uc:.0f} µC of {1e3 * DOSE_MC:.0f} µC allowed")
