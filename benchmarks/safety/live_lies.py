"""A sensor that begins to lie in mid-walk, live: how soon gate or witness tell it, and what goes wrong meanwhile.

Of every person of ``witness.py`` one foot walks through a whole session at 100 Hz: controller, gate and commands, armed
once, 20 mA; and beside it the live witness hears each stride. At half time the sensor begins to lie. The same walk
without the lie says which phase the foot is in. *Latched within*: before so many strides had ended since the lie began;
*stopped within*: of the others those in disorder by then, so that no burst begins; *by the witness*: of those not
latched; *in stance*: ms of current while the foot stands (less the last 150 ms of a stance): median, 95 %,
most. The first row has no lie: what is told there is false. Exit code 3 without data.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import console_of, no_recordings, parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import calibrated
from benchmarks.loop.by_radio import EARLY_NS, MS, RATE_HZ, Walk, by_cable, overlap_ns, session_of, stances
from benchmarks.safety.witness import (
    Change,
    Walker,
    biased,
    exchanged,
    flipped,
    from_half,
    gains,
    lag,
    mirrored,
    walkers,
)
from drivers.simulated.imu.device import even_signal
from fes.control.controller import Controller
from fes.control.runner import Runner
from fes.estimation.sensor_choice import Calibration
from fes.gate import gate_of
from fes.recording import Track
from fes.signals import OperatorAct, OperatorAction, StrideResult
from fes.stimulation.order import NOTED
from fes.walk_record import Note
from fes.witness.verdict import Hearing

SOUND = "as it is"
LIES: dict[str, Change] = {
    SOUND: lambda track: track,
    "accelerometer 40 ms late": lag(40.0),
    "accelerometer 20 ms early": lag(-20.0),
    "gyroscope × 0.5": gains(1.0, 0.5),
    "gyroscope × 0.8": gains(1.0, 0.8),
    "gyroscope × 1.25": gains(1.0, 1.25),
    "gyroscope × 2": gains(1.0, 2.0),
    "accelerometer × 0.8": gains(0.8, 1.0),
    "accelerometer × 1.25": gains(1.25, 1.0),
    "main axis + 15 deg/s": biased(15.0),
    "main axis + 30 deg/s": biased(30.0),
    "main axis' sign": flipped(0),
    "next axis' sign": flipped(1),
    "left-handed": mirrored,
    "gyroscope's x and y exchanged": exchanged,
}
LATCHED, STOPPED, HEARD = (1, 2, 5), (5, 20), (10, 40)  # strides
MUCH_MS = 100.0
SECONDS = 150.0


@dataclass
class Session(Walk):
    """A walk with its strides, until the gate latches."""

    strides: list[StrideResult] = field(default_factory=list)
    latched_ns: int | None = None
    disorder_ns: list[int] = field(default_factory=list)

    def note(self, note: Note) -> None:
        """When the foot came into disorder."""
        if note.source == NOTED and note.severity == "warning":
            self.disorder_ns.append(note.t_ns)

    def stride(self, result: StrideResult) -> None:
        """Kept."""
        self.strides.append(result)


def session(track: Track, calibration: Calibration) -> Session:
    """All of the walk, armed as soon as the gate lets a person, and never again."""
    asked, walk = session_of(track.sensor, "capture2go"), Session()
    gate = gate_of(asked, {track.sensor: calibration.up})
    runner = Runner(Controller(asked, {track.sensor: calibration}), gate, walk, walk, lambda: 0)
    for event in by_cable(track.sensor, even_signal(track, RATE_HZ)):
        runner.handle(event)
        if gate.latched:
            walk.latched_ns = event.t_ns
            break
        if not gate.armed:
            runner.handle(OperatorAct(event.t_ns, OperatorAction.ARM))
            runner.handle(OperatorAct(event.t_ns, OperatorAction.SET_INTENSITY, 1.0))
    return walk


@dataclass(frozen=True)
class Row:
    """One foot under one lie; strides are counted from the lie's beginning, None is never."""

    lie: str
    known: bool
    latched: int | None
    stopped: int | None
    heard: int | None
    stance_ms: float
    length: float


def told_after(track: Track, lied: Session, half_ns: int) -> int | None:
    """After how many strides the live witness tells a lie, at most the last of HEARD."""
    signal = even_signal(track, RATE_HZ)
    t_ns = np.array([event.t_ns for event in by_cable(track.sensor, signal)])
    values = np.hstack((signal.acc_mps2, signal.gyr_radps))
    hearing, read, after = Hearing(track.sensor, RATE_HZ), 0, 0
    for stride in lied.strides:
        end = int(np.searchsorted(t_ns, stride.t_end_ns, "right"))
        hearing.add(t_ns[read:end], values[read:end], [(stride.t_start_ns, stride.t_end_ns)])
        read = end
        if stride.t_end_ns <= half_ns:
            continue
        after += 1
        hearing.hear()
        if hearing.lies:
            return after
        if after >= HEARD[-1]:
            break
    return None


def length_m(strides: Sequence[StrideResult], from_ns: int) -> float:
    """Median of the valid ones since then; NaN without any."""
    lengths = [each.stride_length_m for each in strides if each.valid and each.t_start_ns >= from_ns]
    return float(np.median(lengths)) if lengths else float("nan")


def rows_of(walker: Walker, lies: Sequence[str]) -> list[Row]:
    """One foot under every lie; none where the sound walk cannot be calibrated or is latched."""
    track = walker.track
    if (calibration := calibrated(track)) is None:
        return []
    sound = session(track, calibration)
    events = list(by_cable(track.sensor, even_signal(track, RATE_HZ)))
    half_ns = events[len(events) // 2].t_ns
    stood = stances(sound)
    if sound.latched_ns is not None and sound.latched_ns <= half_ns:
        return []
    rows = []
    for lie in lies:
        changed = from_half(LIES[lie])(track)
        lied = sound if lie == SOUND else session(changed, calibration)
        begun = [(max(begin, half_ns), end) for begin, end in lied.spans() if end > half_ns]
        stance_ms = sum(overlap_ns(span, stood, EARLY_NS) for span in begun) / MS
        ends = [each.t_end_ns for each in sound.strides if each.t_end_ns > half_ns]
        latched = None if lied.latched_ns is None else sum(end < lied.latched_ns for end in ends) + 1
        first_ns = next((t_ns for t_ns in lied.disorder_ns if t_ns > half_ns), None)
        stopped = None if first_ns is None else sum(end < first_ns for end in ends)
        heard = told_after(changed, lied, half_ns) if latched is None else None
        ratio = length_m(lied.strides, half_ns) / length_m(sound.strides, half_ns)
        rows.append(Row(lie, walker.known, latched, stopped, heard, stance_ms, ratio))
    return rows


def table_of_half(rows: Sequence[Row], lies: Sequence[str], *, known: bool) -> Table:
    cells = []
    for lie in lies:
        own = [row for row in rows if row.lie == lie and row.known == known]
        if not own:
            continue
        latched = [row.latched for row in own if row.latched is not None]
        stopped = [row.stopped for row in own if row.latched is None and row.stopped is not None]
        heard = [row.heard for row in own if row.heard is not None]
        untold = sum(row.latched is row.stopped is row.heard is None for row in own)
        middle, most = np.percentile([row.stance_ms for row in own], (50, 95))
        cells.append([
            lie, str(len(own)), *(str(sum(n <= limit for n in latched)) for limit in LATCHED),
            str(sum(n > LATCHED[-1] for n in latched)), *(str(sum(n <= limit for n in stopped)) for limit in STOPPED),
            *(str(sum(n <= limit for n in heard)) for limit in HEARD), str(untold),
            f"{middle:.0f}, {most:.0f}, {max(row.stance_ms for row in own):.0f}",
            str(sum(row.stance_ms > MUCH_MS for row in own)), spread([row.length for row in own], ".2f"),
        ])  # fmt: skip
    columns = (
        "lie", "feet", *(f"latched within {n}" for n in LATCHED), "later", *(f"stopped within {n}" for n in STOPPED),
        *(f"by the witness in {n}" for n in HEARD),
        "never", "in stance, ms", f"over {MUCH_MS:.0f} ms", "length",
    )  # fmt: skip
    return table_of(f"Persons whom the bounds {'were chosen on' if known else 'had not seen'}", columns, cells)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--lies", nargs="*", choices=list(LIES), default=list(LIES))
    parser.add_argument("--feet", type=int, help="about so many, evenly among all")
    options = parser.parse_args()
    feet = [walker for walker in walkers(SECONDS) if walker.lied]
    feet = feet[:: max(len(feet) // (options.feet or len(feet)), 1)]
    if not feet:
        return no_recordings(data_folder())
    rows, left_out = list[Row](), 0
    with suppress(KeyboardInterrupt):  # the tables are of those who walked by then
        for walker in feet:
            found = rows_of(walker, options.lies)
            left_out += not found
            rows += found
            print(walker.foot.data_set, walker.foot.person, len(found), file=sys.stderr, flush=True)
    tables = [table_of_half(rows, options.lies, known=known) for known in (False, True)]
    notes = [f"{left_out} of {len(feet)} feet cannot be calibrated, or are latched before the lie begins."]
    publish(console_of(220), tables, options, notes, data_folder())
    return 0


if __name__ == "__main__":
    sys.exit(main())
