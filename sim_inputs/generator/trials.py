"""The bundled set of recorded steps: ``python -m sim_inputs.generator.trials OUT_DIR`` makes every file of it again."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fes.recording import Recording, write_recording
from fes.signals import G_MPS2
from fes.simulation.sensor import ImuModel, Placement
from fes.simulation.truth import Truth, write_truth
from sim_inputs.generator.observe import observe
from sim_inputs.generator.session import Session, new_session
from sim_inputs.generator.walk import Style, heel_lift, sit_and_stand, turn_on_the_spot, weight_shifts

KMH = 1.0 / 3.6
INSTEP = {"right_foot": Placement((0.070, -0.005, 0.068), (3.0, 21.0, -4.0))}
BOTH = {
    "right_foot": Placement((0.070, -0.005, 0.068), (3.0, 21.0, -4.0)),
    "left_foot": Placement((0.068, 0.006, 0.067), (-4.0, 19.0, 5.0)),
}
# the left sensor is upside down about its long axis and turned round, the right one rotated by large angles
ASKEW = {
    "right_foot": Placement((0.065, -0.010, 0.068), (-20.0, 35.0, 15.0)),
    "left_foot": Placement((0.066, 0.012, 0.066), (25.0, -30.0, 160.0)),
}

HEALTHY = Style(pre_swing_s=0.25, swing_s=0.42, loading_s=0.10, stance_s=0.36, push_deg=66.0, strike_deg=-22.0)
# a little weaker, later, flatter: the mild asymmetry of most people
WEAKER = replace(HEALTHY, push_deg=62.0, strike_deg=-19.0, swing_s=0.41, lift_m=0.042, toe_out_deg=9.0, ring_mps2=12.0)
PAIR = {"right_foot": HEALTHY, "left_foot": WEAKER}
# Negård et al. (2005), Table 1, patient 2
PATIENT_2 = Style(
    pre_swing_s=0.40, swing_s=0.69, loading_s=0.195, stance_s=0.74, push_deg=48.0, strike_deg=9.0, dangle_deg=5.0,
    invert_deg=9.0, swerve_deg=5.0, toe_out_deg=9.0, circumduction_m=0.045, lift_m=0.022, toe_clearance_m=0.009,
    fall_mps=0.28, forward_mps=0.20, stop_s=0.017, ring_mps2=9.0, drift_deg=1.8, creep_m=0.0025, slow_share=0.70,
    jolt_mps2=3.0, contact="forefoot",
    spread_pre_swing=0.05, spread_swing=0.04, spread_loading=0.21, spread_stance=0.085, spread_deg=1.8,
    spread_m=0.014, spread_clearance=0.22,
)  # fmt: skip
PATIENT_1 = replace(
    PATIENT_2, pre_swing_s=0.43, swing_s=0.64, loading_s=0.20, stance_s=0.86, push_deg=45.0, strike_deg=8.0,
    dangle_deg=4.0, invert_deg=12.0, circumduction_m=0.055, lift_m=0.016, toe_clearance_m=0.006, fall_mps=0.25,
    forward_mps=0.15, ring_mps2=8.0, toe_out_deg=12.0,
)  # fmt: skip
SOFT = replace(
    PATIENT_1, strike_deg=2.0, dangle_deg=2.0, invert_deg=1.5, fall_mps=0.03, forward_mps=0.02, stop_s=0.12,
    ring_mps2=0.0, spread_deg=0.5, loading_s=0.09, contact="soft", push_deg=43.0,
)  # fmt: skip
SLOW_HEALTHY = replace(
    HEALTHY, pre_swing_s=0.30, swing_s=0.44, loading_s=0.13, stance_s=0.45, push_deg=56.0, strike_deg=-16.0,
    fall_mps=0.40, forward_mps=0.55, ring_mps2=14.0,
)  # fmt: skip

IMU = ImuModel()
IMU_8G = replace(IMU, acc_range_mps2=8.0 * G_MPS2, gyr_range_radps=math.radians(500.0))
IMU_FAULTY = replace(IMU, jitter_s=0.0006, lost=0.004, doubled=0.003)


@dataclass(frozen=True, slots=True)
class Trial:
    """One bundled recording: what is done, with which sensors, from which seed."""

    name: str
    seed: int
    rate_hz: float
    placements: dict[str, Placement]
    fill: Callable[[Session], None]
    description: str
    model: ImuModel = IMU
    reference: str = ""

    def session(self) -> Session:
        """The finished session."""
        session = new_session(self.name, self.seed, self.placements)
        self.fill(session)
        session.finish()
        return session

    def make(self) -> tuple[Recording, Truth]:
        """The recording and its truth; the same at every call."""
        session = self.session()
        return session.recording(self.rate_hz, self.model, self.description), observe(session, reference=self.reference)


def _treadmill(
    styles: dict[str, Style], count: int, speed_mps: float, ramp_s: float, *, early: bool = False
) -> Callable[[Session], None]:
    def fill(session: Session) -> None:
        session.stand(4.0)
        session.walk(styles, count, speed_mps, ramp_s=ramp_s, early=early)
        session.stand(2.5)

    return fill


def _not_walking(session: Session) -> None:
    feet = list(session.feet.values())
    rng = session.rng
    session.stand(6.0)
    session.do("weight_shift", weight_shifts(rng, feet, session.now_s, 8))
    session.stand(2.0)
    session.do("turning", turn_on_the_spot(rng, feet, session.now_s, 360.0, 6))
    session.stand(2.5)
    for foot, height, up, hold, down in (
        (0, 18.0, 1.1, 0.8, 1.0), (1, 15.0, 0.9, 0.5, 0.8), (0, 25.0, 0.35, 0.2, 0.22), (1, 22.0, 0.30, 0.1, 0.20),
        (0, 30.0, 0.25, 0.05, 0.18), (0, 20.0, 0.28, 0.3, 0.25), (1, 28.0, 0.5, 0.4, 0.3),
    ):  # fmt: skip
        session.do("heel_lift", heel_lift(feet[foot], session.now_s + 0.2, height, up, hold, down) + 0.3)
        session.stand(1.0)
    down, up, stood = sit_and_stand(rng, feet, session.now_s, 7.0)
    session.do("sitting_down", down)
    session.do("sitting", up)
    session.do("standing_up", stood)
    session.stand(4.0)
    styles = dict.fromkeys(session.feet, SLOW_HEALTHY)
    session.walk(styles, 10, 0.9, ramp_s=3.2, early=True)
    session.stand(4.0)
    session.do("turning", turn_on_the_spot(rng, feet, session.now_s, -90.0, 2))
    session.stand(2.5)


TRIALS: tuple[Trial, ...] = (
    Trial(
        "negard_patient1", 11, 500.0, INSTEP, _treadmill({"right_foot": PATIENT_1}, 40, 1.1 * KMH, 0.8),
        "Drop foot on the right, treadmill 1.1 km/h, 40 strides; the set-up of Negård et al. (2005), patient 1",
        IMU_8G, "right_foot",
    ),
    Trial(
        "negard_patient2", 12, 500.0, INSTEP, _treadmill({"right_foot": PATIENT_2}, 45, 1.5 * KMH, 0.9),
        "Drop foot on the right, treadmill 1.5 km/h, 45 strides; the set-up of Negård et al. (2005), patient 2",
        IMU_8G, "right_foot",
    ),
    Trial(
        "both_feet_100hz", 13, 100.0, BOTH, _treadmill(PAIR, 46, 1.2, 4.0, early=True),
        "Both feet, comfortable walk on a treadmill at 1.2 m/s, mild asymmetry, 100 Hz, a faultless link",
    ),
    Trial(
        "both_feet_200hz", 14, 200.0, BOTH, _treadmill(PAIR, 46, 1.2, 4.0, early=True),
        "Both feet, comfortable walk on a treadmill at 1.2 m/s, 200 Hz with jitter, lost and doubled samples",
        IMU_FAULTY,
    ),
    Trial(
        "not_walking", 15, 200.0, BOTH, _not_walking,
        "Standing, weight shifts, turning, heels lifted, sitting; then belt start, 10 strides, belt stop; both feet",
    ),
    Trial(
        "soft_contact", 16, 200.0, INSTEP, _treadmill({"right_foot": SOFT}, 30, 1.1 * KMH, 0.8),
        "Drop foot set down so softly that no contact shows: every stride ends by T6", IMU_8G,
    ),
    Trial(
        "misaligned", 17, 200.0, ASKEW, _treadmill(PAIR, 40, 1.2, 4.0, early=True),
        "Both feet at 1.2 m/s, sensors strapped on at large odd angles, the left one turned round",
    ),
)  # fmt: skip
CSV_EXAMPLE = Trial(
    "example_csv", 18, 100.0, INSTEP, _treadmill({"right_foot": SLOW_HEALTHY}, 5, 0.9, 1.6),
    "Five strides of one foot at 0.9 m/s as plain CSV, to look at and to imitate",
)  # fmt: skip


def write_trial(trial: Trial, folder: Path, suffix: str = ".parquet") -> None:
    """Write one trial's recording, sidecar and truth into ``folder``, replacing what is there."""
    recording, truth = trial.make()
    write_recording(recording, folder / f"{trial.name}{suffix}", overwrite=True)
    write_truth(truth, folder)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the bundled set into a folder; the same bytes every time."""
    parser = argparse.ArgumentParser(prog="python -m sim_inputs.generator.trials", description=main.__doc__)
    parser.add_argument("folder", type=Path, help="where to write; made if missing")
    parser.add_argument("--only", metavar="NAME", help="write only this trial")
    options = parser.parse_args(arguments)
    chosen = [trial for trial in (*TRIALS, CSV_EXAMPLE) if options.only in (None, trial.name)]
    if not chosen:
        names = ", ".join(trial.name for trial in (*TRIALS, CSV_EXAMPLE))
        parser.error(f"--only {options.only}: no such trial; choose one of {names}")
    options.folder.mkdir(parents=True, exist_ok=True)
    for trial in chosen:
        write_trial(trial, options.folder, ".csv" if trial is CSV_EXAMPLE else ".parquet")
        print(f"{options.folder / trial.name}: {trial.description}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
