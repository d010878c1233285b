"""Walking backward, calibrated forward: how many strides are refused, and how many are taken for strides forward.

    python benchmarks/accuracy/backward.py [--data FOLDER] [--json FILE]

A walk that runs backward in time is one backward: joints go nearly the same way (Winter et al. 1989, Hum Mov Sci 8).
Recordings of feet are turned round in time; the calibration is that of the walk forward. The phases time steps
backward wrongly, so what counts is that strides say so, for no burst starts before strides that carry the foot forward.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, replace

from rich.table import Table

from benchmarks.accuracy.every_walker import causal, feet_of
from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.command_line import console_of, parser_of, save
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import CalibrationError
from fes.recording.tracks import Track

SETS = ("stroke_treadmill", "pyshoe_vicon", "ruler_walks", "gaitmap_walk", "footswitch_treadmill", "stroke_walks")


@dataclass
class Backward:
    """One foot walked backward: its closed strides, by what became of them."""

    data_set: str
    run: str
    sensor: str
    strides: int = 0
    refused_as_backward: int = 0
    refused_otherwise: int = 0
    taken_as_forward: int = 0


def reversed_in_time(track: Track) -> Track:
    """The same movement, last sample first."""
    t_ns, t_sensor_ns = track.t_ns, track.t_sensor_ns
    return replace(
        track,
        t_ns=t_ns[0] + t_ns[-1] - t_ns[::-1],
        t_sensor_ns=t_sensor_ns[0] + t_sensor_ns[-1] - t_sensor_ns[::-1],
        acc_mps2=track.acc_mps2[::-1].copy(),
        gyr_radps=-track.gyr_radps[::-1],
    )


def main(arguments: list[str] | None = None) -> int:
    """Print a table of all sets; 3 without data."""
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    found: list[Backward] = []
    for foot in feet_of(options.data, SETS):
        try:
            calibration = calibrate_track(foot.track)
        except CalibrationError:
            continue
        _, strides = causal(reversed_in_time(foot.track), calibration)
        one = Backward(foot.data_set, foot.run, foot.track.sensor, len(strides))
        for stride in strides:
            one.taken_as_forward += stride.valid
            one.refused_as_backward += not stride.valid and stride.reason.startswith("went backward")
            one.refused_otherwise += not stride.valid and not stride.reason.startswith("went backward")
        found.append(one)
    if not found:
        print(f"No recordings in {options.data}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    groups: dict[str, Counter[str]] = defaultdict(Counter)
    for one in found:
        groups[one.data_set].update({key: value for key, value in asdict(one).items() if isinstance(value, int)})
    table = Table("set", "strides", "refused: went backward", "refused otherwise", "taken as forward", "%")
    for name, counts in groups.items():
        table.add_row(
            name, str(counts["strides"]), str(counts["refused_as_backward"]), str(counts["refused_otherwise"]),
            str(counts["taken_as_forward"]), f"{100.0 * counts['taken_as_forward'] / counts['strides']:.1f}",
        )  # fmt: skip
    console_of(120).print(table)
    save([asdict(one) for one in found], options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
