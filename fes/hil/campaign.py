"""A campaign: every fault of the table, one after the other, on one transport."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from drivers.imu.port import ImuLost
from drivers.simulated.bus_guests import Rogue
from drivers.stimulator.port import StimulatorLost
from fes.hil.attempts import (
    make_attempt,
)
from fes.hil.baseline import Baseline
from fes.hil.campaign_bench import CampaignBench, CampaignBroken
from fes.hil.devices import BusWitness, Hardware, hardware_session, start_devices
from fes.hil.results import Attempt, Campaign, Row
from fes.hil.scenarios import Needs, Scenario

NOT_BASELINE: Final = ("cpu_hogs", "controller_starved")  # these take the processor away on purpose
BROKEN_IN_A_ROW: Final = 3
SPOILT_AT_MOST: Final = 4

Progress = Callable[[Scenario, int, Attempt | None], None]
"""Called before (None) and after every attempt."""


def simulated_campaign(
    transport: str,
    scenarios: Sequence[Scenario],
    repeat: int,
    folder: Path,
    progress: Progress,
    channel: str = "vcan0",
    *,
    closed_loop: bool = False,
) -> Campaign:
    """Run these scenarios on simulated devices, each ``repeat`` times; whatever ends it, nothing is left running.

    Args:
        folder: for the devices' records and the sessions' logs; must exist.
        channel: the interface's name for ``socketcan``.
        closed_loop: with a virtual patient, who feels what is delivered, in the place of a recorded walk.

    Raises:
        Unavailable: the transport is not to be had on this machine.
        CampaignBroken: three attempts in a row could not even be made.
    """
    with ExitStack() as stack:
        devices = start_devices(transport, folder, stack, channel, closed_loop=closed_loop)
        bench = CampaignBench(devices, devices.capabilities | machine_capabilities(), stack)
        return run_campaign(bench, transport, scenarios, repeat, progress)


def hardware_campaign(
    path: Path, calibration: Path, scenarios: Sequence[Scenario], repeat: int, folder: Path, progress: Progress
) -> Campaign:
    """Run these scenarios, which must be of the host's side, on the devices of a session file.

    Raises:
        ConfigError: the settings cannot be used, or nobody but the controller can hear the stimulator.
        BusError: the bus cannot be opened.
        CampaignBroken: three attempts in a row could not even be made.
    """
    session = hardware_session(path)
    with ExitStack() as stack:
        witness = BusWitness(stack.enter_context(Rogue(session.bus)))
        witness.start(stack)
        hardware = Hardware(folder, path, calibration, session.stimulation.intensity, witness)
        bench = CampaignBench(hardware, machine_capabilities(), stack, by_hand=True)
        return run_campaign(bench, f"hardware ({path.name})", scenarios, repeat, progress)


def run_campaign(
    bench: CampaignBench, name: str, scenarios: Sequence[Scenario], repeat: int, progress: Progress
) -> Campaign:
    """The rows, one after the other.

    Raises:
        CampaignBroken: three attempts in a row could not even be made.
    """
    started, begin_s = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
    with ExitStack() as stack:
        stack.callback(bench.close)
        baseline = Baseline()
        stack.callback(baseline.end)
        bench.gaps = baseline.gaps
        rows: list[Row] = []
        broken = 0
        for scenario in scenarios:
            row = Row(scenario)
            rows.append(row)
            if lacking := sorted(scenario.needs - bench.capabilities):
                row.skipped = f"needs {', '.join(lacking)}"
                continue
            if scenario.name in NOT_BASELINE:
                baseline.leave_out(True)
            for n in range(scenario.attempts(repeat)):
                progress(scenario, n, None)
                try:
                    found = _undisturbed(bench, row, n)
                    broken = 0
                except (CampaignBroken, StimulatorLost, ImuLost, ProcessLookupError) as error:
                    broken += 1
                    found = Attempt(faults=(str(error),))
                    bench.end_session()
                    if broken >= BROKEN_IN_A_ROW:
                        raise CampaignBroken(f"{scenario.name}: {error}") from error
                row.attempts.append(found)
                progress(scenario, n, found)
            if scenario.name in NOT_BASELINE:
                baseline.leave_out(False)
        bench.close()
        lateness = baseline.end()
    seconds = time.monotonic() - begin_s
    return Campaign(name, tuple(rows), lateness, started, seconds, repeat, tuple(bench.unasked), tuple(bench.away))


def _undisturbed(bench: CampaignBench, row: Row, n: int) -> Attempt:
    """The n-th attempt; made again while the machine itself spoils it, a few times at most."""
    for _ in range(SPOILT_AT_MOST):
        found = make_attempt(bench, row.scenario, n)
        if not found.away:
            return found
        row.away.append(found.named)
    return found


def machine_capabilities() -> frozenset[Needs]:
    """What this machine lets the campaign do."""
    found = {Needs.PROC} if Path("/proc/self/task").is_dir() else set()
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1 and _may_be_first():
        found.add(Needs.FIFO)
    return frozenset(found)


def _may_be_first() -> bool:
    """Whether SCHED_FIFO is granted; tried in a process of its own."""
    pid = os.fork()
    if not pid:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            os._exit(0)
        except (OSError, AttributeError):
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def save_campaign(campaign: Campaign, folder: Path) -> tuple[Path, Path]:
    """Write ``hil.json`` and ``hil.md``; both paths."""
    as_json, as_text = folder / "hil.json", folder / "hil.md"
    as_json.write_text(json.dumps(campaign.to_dict(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    as_text.write_text(campaign.to_markdown(), encoding="utf-8")
    return as_json, as_text
