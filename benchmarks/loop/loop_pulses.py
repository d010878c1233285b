"""What the closed loop makes of pulses that come a little late, or one more or less of them in a burst.

    python benchmarks/loop/loop_pulses.py [--runs 30] [--late-ms 12] [--jitter-ms 0] [--same-number]

Runs of the drop-foot patient of `fes demo --closed-loop` in one process, each compared with the undisturbed one: what a
run between processes may differ by for no other reason than its timing (tests/transports/test_virtual_patient_loop.py).
"""

from __future__ import annotations

import argparse
import re
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from unittest.mock import patch

from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes.config import validate_session
from fes.estimation.sensor_choice import Calibration
from fes.hil.closed_loop import one_process
from fes.hil.closed_loop.one_process import CURRENT_MA, patient
from fes.hil.closed_loop.processes import armed_protocol
from fes.hil.settings import patient_calibration, patient_session_text
from fes.session_log import read_session
from fes.simulation.forward import DeliveredPulse, VirtualStride

MS = 1_000_000
SECONDS, PAUSE_MS = 42.0, 200
CURRENT = re.compile(r"→ ([\d.]+) mA")


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Each burst up to ``late_ms`` later, each pulse up to ``jitter_ms``; in two bursts of three one more or less."""

    seed: int
    late_ms: float
    jitter_ms: float
    miscounted: bool


class DisturbedStimulator(InProcessStimulator):
    """The simulated stimulator whose pulses reach the patient otherwise than it made them."""

    disturbance: Disturbance | None = None

    def __init__(self, session_id: int, boot_id: int = 1) -> None:
        super().__init__(session_id, boot_id)
        self._random = Random(self.disturbance.seed if self.disturbance else 0)
        self._newest_ns = -1000 * MS
        self._number = self._odd = 0
        self._late_ns = 0
        self._copies = 1

    def take_pulses(self) -> list[DeliveredPulse]:
        """The pulses since the last call, by time, as they reach the patient."""
        made = super().take_pulses()
        return made if self.disturbance is None else [p for pulse in made for p in self._felt(pulse, self.disturbance)]

    def _felt(self, pulse: DeliveredPulse, how: Disturbance) -> list[DeliveredPulse]:
        if pulse.t_ns - self._newest_ns > PAUSE_MS * MS:
            self._number, self._odd = 0, self._random.randrange(8, 30)
            self._copies = self._random.choice((0, 1, 2)) if how.miscounted else 1
            self._late_ns = round(self._random.uniform(0.0, how.late_ms) * MS)
        self._newest_ns = pulse.t_ns
        self._number += 1
        late_ns = self._late_ns + round(self._random.uniform(0.0, how.jitter_ms) * MS)
        felt = replace(pulse, t_ns=pulse.t_ns + late_ns)
        return [felt] * (self._copies if self._number == self._odd else 1)


@dataclass(frozen=True, slots=True)
class TrackedBlock:
    """The strides of the affected foot, when which transition fired (ms), and the current after each change (mA)."""

    strides: list[VirtualStride]
    phases_ms: dict[tuple[str, str], list[float]]
    currents_ma: list[float]


def walked(folder: Path, calibrations: Mapping[str, Calibration], disturbance: Disturbance | None) -> TrackedBlock:
    """One run."""
    DisturbedStimulator.disturbance = disturbance
    settings = patient()
    text = patient_session_text(settings, current_ma=CURRENT_MA)
    session = validate_session(tomllib.loads(text), folder / "session.toml", text)
    log = folder / f"{'as it is' if disturbance is None else disturbance.seed}.feslog"
    lived = one_process.run_in_one_process(settings, session, calibrations, armed_protocol(SECONDS), log, "")
    record = read_session(log)
    phases: dict[tuple[str, str], list[float]] = {}
    for change in record.phases:
        phases.setdefault((change.foot, change.transition.name), []).append(change.t_ns / MS)
    found = [CURRENT.search(note.text) for note in record.notes if note.source == "tuning"]
    strides = [stride for stride in lived.strides if stride.foot == settings.affected_foot]
    return TrackedBlock(strides, phases, [float(one[1]) for one in found if one])


def apart(one: TrackedBlock, other: TrackedBlock) -> tuple[float, float, float]:
    """Greatest difference of toe clearance (mm), of a phase change (ms), and of the last current (mA)."""
    toe = max(abs(a.toe_clearance_m - b.toe_clearance_m) for a, b in zip(one.strides, other.strides, strict=False))
    phase = max(
        abs(a - b) for key, times in one.phases_ms.items()
        for a, b in zip(times, other.phases_ms.get(key, []), strict=False)
    )  # fmt: skip
    return 1e3 * toe, phase, abs(one.currents_ma[-1] - other.currents_ma[-1])


def main() -> None:
    """Run, and print how far the runs lie from the undisturbed one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--late-ms", type=float, default=12.0, help="a burst comes up to so much later")
    parser.add_argument("--jitter-ms", type=float, default=0.0, help="each of its pulses once more up to so much")
    parser.add_argument("--same-number", action="store_true", help="no pulse more or less in any burst")
    asked = parser.parse_args()
    calibrations = patient_calibration(patient()).calibrations
    disturbed = patch.object(one_process, "InProcessStimulator", DisturbedStimulator)
    with disturbed, tempfile.TemporaryDirectory() as name:
        usual = walked(Path(name), calibrations, None)
        found = [
            apart(
                walked(Path(name), calibrations, Disturbance(n, asked.late_ms, asked.jitter_ms, not asked.same_number)),
                usual,
            )
            for n in range(asked.runs)
        ]
    toe, phase, current = (sorted(values) for values in zip(*found, strict=True))
    print(f"{asked.runs} runs against the undisturbed one, greatest differences: ", end="")
    print(f"toe clearance {toe[-1]:.1f} mm, phases {phase[-1]:.0f} ms, last current {current[-1]:.1f} mA", end=" ")
    print(f"(of {usual.currents_ma[-1]:.1f}; {sum(c > 1.0 for c in current)} runs by more than 1.0)")


if __name__ == "__main__":
    main()
