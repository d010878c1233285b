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
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import no_recordings, parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import calibrated
from benchmarks.loop.by_radio import EARLY_NS, MS, RATE_HZ, Walk, by_cable, overlap_ns, session_of, stances, walked
from benchmarks.safety.witness import Change, Walker, biased, flipped, from_half, gains, lag, walkers
from drivers.simulated.imu.device import even_signal
from fes.estimation.sensor_choice import Calibration
from fes.recording import Track
from fes.signals import StrideResult
from fes.stimulation.order import NOTED
from fes.witness.verdict import Hearing

SOUND = "as it is"
LIES: dict[str, Change] = {
    SOUND: lambda track: track,
    "accelerometer 40 ms late": lag(40.0),
    "gyroscope × 0.5": gains(1.0, 0.5),
    "gyroscope × 0.8": gains(1.0, 0.8),
    "gyroscope × 2": gains(1.0, 2.0),
    "main axis + 30 deg/s": biased(30.0),
    "main axis' sign": flipped(0),
}
LATCHED, STOPPED, HEARD = (1, 2, 5), (5, 20), (10, 40)  # strides
MUCH_MS = 100.0
SECONDS = 150.0


def session(track: Track, calibration: Calibration) -> Walk:
    """All of the walk, armed once, until the gate latches."""
    events = by_cable(track.sensor, even_signal(track, RATE_HZ))
    return walked(session_of(track.sensor, "capture2go"), calibration, events, again=False)


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


def told_after(track: Track, lied: Walk, half_ns: int) -> int | None:
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


def rows_of(walker: Walker) -> list[Row]:
    """One foot under every lie; none where the sound walk cannot be calibrated or is latched."""
    track = walker.track
    if (calibration := calibrated(track)) is None:
        return []
    sound = session(track, calibration)
    events = list(by_cable(track.sensor, even_signal(track, RATE_HZ)))
    half_ns = events[len(events) // 2].t_ns
    stood = stances(sound)
    if sound.latches and sound.latches[0][0] <= half_ns:
        return []
    ends = [each.t_end_ns for each in sound.strides if each.t_end_ns > half_ns]
    rows = []
    for lie, change in LIES.items():
        changed = from_half(change)(track)
        lied = sound if lie == SOUND else session(changed, calibration)
        begun = [(max(begin, half_ns), end) for begin, end in lied.spans() if end > half_ns]
        stance_ms = sum(overlap_ns(span, stood, EARLY_NS) for span in begun) / MS
        latched = sum(end < lied.latches[0][0] for end in ends) + 1 if lied.latches else None
        warned_ns = (n.t_ns for n in lied.notes if (n.source, n.severity) == (NOTED, "warning") and n.t_ns > half_ns)
        first_ns = next(warned_ns, None)  # in disorder
        stopped = None if first_ns is None else sum(end < first_ns for end in ends)
        heard = told_after(changed, lied, half_ns) if latched is None else None
        ratio = length_m(lied.strides, half_ns) / length_m(sound.strides, half_ns)
        rows.append(Row(lie, walker.known, latched, stopped, heard, stance_ms, ratio))
    return rows


def table_of_half(rows: Sequence[Row], *, known: bool) -> Table:
    cells = []
    for lie in LIES:
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
    parser.add_argument("--feet", type=int, help="about so many, evenly among all")
    options = parser.parse_args()
    feet = [walker for walker in walkers(SECONDS) if walker.lied]
    feet = feet[:: max(len(feet) // (options.feet or len(feet)), 1)]
    if not feet:
        return no_recordings(data_folder())
    rows, left_out = list[Row](), 0
    with suppress(KeyboardInterrupt):  # the tables are of those who walked by then
        for walker in feet:
            found = rows_of(walker)
            left_out += not found
            rows += found
            print(walker.foot.data_set, walker.foot.person, len(found), file=sys.stderr, flush=True)
    tables = [table_of_half(rows, known=known) for known in (False, True)]
    notes = [f"{left_out} of {len(feet)} feet cannot be calibrated, or are latched before the lie begins."]
    publish(tables, options, notes, data_folder())
    return 0


if __name__ == "__main__":
    sys.exit(main())
