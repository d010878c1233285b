"""A walk by a simulated radio through driver, stream, controller and gate, on a clock of the simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from benchmarks.loop import by_radio as radios
from drivers.simulated.imu.device import ImuSignal, Radio, even_signal
from fes import limits
from fes.calibration.recording import calibrate_track
from fes.estimation.sensor_choice import Calibration
from fes.recording import read_recording
from fes.signals import NS_PER_S, Event, ImuSample
from fes.stimulation.onset import FALSE_NS

FOOT, MS = "right_foot", 1_000_000
TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
BUDGET_NS = limits.RADIO.max_data_age_ms * MS


@dataclass
class Trial:
    """A foot's signal, its calibration, and what the cable makes of it."""

    signal: ImuSignal
    calibration: Calibration
    cable: radios.Walk = field(init=False)

    def __post_init__(self) -> None:
        session = radios.session_of(FOOT, "capture2go")
        self.cable = radios.walked(session, self.calibration, radios.by_cable(FOOT, self.signal))

    def by_radio(self, setting: radios.Setting, seen: list[Event] | None = None) -> radios.Walk:
        session = radios.session_of(FOOT, "capture2go_ble", packed=setting.packed)
        events = radios.by_radio(session, self.signal, setting.adjust, setting.at)
        return radios.walked(session, self.calibration, kept(events, seen))


def kept(events: Iterator[Event], seen: list[Event] | None) -> Iterator[Event]:
    for event in events:
        if seen is not None:
            seen.append(event)
        yield event


@pytest.fixture(scope="module")
def trial() -> Trial:
    track = read_recording(TRIAL).tracks[FOOT]
    return Trial(even_signal(track, radios.RATE_HZ), calibrate_track(track))


def measured_ns(trial: Trial, sample: ImuSample) -> int:
    """When it was measured in truth: by its values, near the time that it says."""
    period_ns = NS_PER_S / radios.RATE_HZ / (1.0 + 1e-6 * radios.DRIFT_PPM)
    about = round((sample.t_sensor_ns - radios.BEGIN_NS) / period_ns)
    near = np.arange(max(about - 20, 0), min(about + 20, trial.signal.size))
    off = np.abs(trial.signal.acc_mps2[near] - sample.acc_mps2).sum(axis=1)
    off += np.abs(trial.signal.gyr_radps[near] - sample.gyr_radps).sum(axis=1)
    return radios.BEGIN_NS + round(float(near[off.argmin()]) * period_ns)


@pytest.mark.requirement("SR-29", "SR-30")
def test_bursts_begin_as_by_cable_within_40_ms_and_nothing_is_over_a_limit(trial: Trial) -> None:
    setting, seen = radios.Setting("", 30.0, 0.02), list[Event]()
    walk, figures = trial.by_radio(setting, seen), radios.Figures()
    figures.add(trial.cable, walk, 60.0)
    assert figures.bursts >= 30
    assert figures.over == 0
    # the first strides have none yet: not before the end can be predicted
    assert figures.lost <= 4
    assert np.percentile(np.abs(figures.late_ms), 95) <= 40.0
    assert max(figures.stance_ms) <= (BUDGET_NS + FALSE_NS) / MS
    walking = [each for each in seen if isinstance(each, ImuSample) and np.linalg.norm(each.gyr_radps) > 1.0]
    late_ms = [(each.t_sensor_ns - measured_ns(trial, each)) / MS for each in walking]
    assert max(late_ms) <= 0.01  # none counts as younger than it is
    assert min(late_ms) >= -30.0
    assert trial.by_radio(setting).commands == walk.commands  # the same radio gives the same commands


@pytest.mark.requirement("SR-29")
def test_a_backlog_begins_no_burst_and_ends_the_one_under_way(trial: Trial) -> None:
    seen = list[Event]()
    walk = trial.by_radio(radios.Setting("", 30.0, away_s=0.4), seen)
    samples = [event for event in seen if isinstance(event, ImuSample)]
    came_ns = np.array([sample.t_ns for sample in samples])
    newest_ns = np.maximum.accumulate([sample.t_sensor_ns for sample in samples])
    on = [command for command in walk.commands if command.on]
    assert len(on) > 500
    for command in on:
        assert command.t_ns - newest_ns[np.searchsorted(came_ns, command.t_ns, "right") - 1] <= BUDGET_NS
    assert any("data" in text and "old" in text for _, text in walk.latches)


@pytest.mark.requirement("SR-29")
def test_a_radio_that_falls_silent_leaves_current_for_its_budget_at_most(trial: Trial) -> None:
    found = radios.silences(trial.calibration, FOOT, trial.signal, trial.cable)
    assert len(found) >= 4
    assert max(on_ns for on_ns, _ in found) <= BUDGET_NS + 50 * MS


def test_whatever_the_radio_does_to_itself_nothing_is_over_a_limit(trial: Trial) -> None:
    def at(radio: Radio, t_ns: int) -> None:
        if t_ns - radios.BEGIN_NS > 30 * NS_PER_S and not radio.lose:
            radio.lose, radio.interval_s = 3, 0.05

    session = radios.session_of(FOOT, "capture2go_ble")
    walk = radios.walked(session, trial.calibration, radios.by_radio(session, trial.signal, lambda radio: None, at))
    assert not any(map(radios.over, walk.commands))
