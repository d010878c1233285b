"""What really happened: foot poses, phases and strides, measured on the finished path, written and read back.

Phases by physical criteria, not by what a sensor shows:

- *pre-swing* begins when the heel has risen 5 mm above its height in that stance, for the last time before toe-off;
- *swing* begins when the toe leaves the ground (toe-off, FO), *loading response* at first contact (IC): both are
  known exactly, for the model decides when the ground carries the foot;
- *stance* begins when the foot lies flat: sole within 2° of level in pitch and roll and
  heel less than 5 mm up, for good until the heel rises.
"""

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from fes.signals import FloatArray, IntArray

Row = TypeVar("Row")
HEEL_UP_M = 0.005
TILT_RAD = math.radians(2.0)


@dataclass(frozen=True, slots=True)
class TruthStride:
    """One stride of one foot, times in s from the recording's start, lengths in m in the belt's frame."""

    foot: str  # sensor name
    number: int  # 1, 2, … per foot
    t_start_s: float  # quietest instant of the stance before the swing
    t_end_s: float  # quietest instant of the stance after it
    t_pre_swing_s: float  # pre-swing begins (heel 5 mm up)
    t_swing_s: float  # swing begins (toe-off, FO)
    t_loading_response_s: float  # loading response begins (initial contact, IC)
    t_stance_s: float  # stance begins (foot flat)
    stride_length_m: float  # horizontal distance of the sensor between t_start_s and t_end_s
    clearance_m: float  # greatest height of the sensor above where it is at t_start_s
    toe_clearance_m: float  # least height of the toe over 30–80 % of the swing, above its height in stance
    heel_clearance_m: float  # greatest height of the heel above its height in stance
    foot_strike_deg: float  # angle of the sole at IC, toe-up positive
    turn_deg: float  # change of heading, to the left positive
    contact: str  # "heel", "flat", "forefoot", or "soft": so gentle that an accelerometer need not see it
    steady: bool  # the belt ran at full speed from t_start_s to t_end_s
    walking: bool  # part of a walk (False: a step while turning on the spot)

    @property
    def loading_detectable(self) -> bool:
        """False where the contact is too soft for transition T3: T6 is the right way into stance."""
        return self.contact != "soft"


@dataclass(frozen=True, slots=True, eq=False)
class FootTruth:
    """One foot at N instants: positions (N, 3) in m in the belt's frame, z up, ground at 0.

    ``q_world_from_sensor`` (N, 4) is wxyz; ``phase`` (N,) holds the numbers of :class:`statemachine.phases.Phase`.
    """

    t_ns: IntArray
    sensor_m: FloatArray
    toe_m: FloatArray
    heel_m: FloatArray
    q_world_from_sensor: FloatArray
    phase: IntArray


@dataclass(frozen=True, slots=True)
class Activity:
    """From ``start_s`` to ``end_s`` the person does ``activity``; ``walking`` says whether that is walking."""

    start_s: float
    end_s: float
    activity: str
    walking: bool


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The truth of one recording; ``reference`` (N, 4) is t (s) and the marker in the lab frame (m), if recorded."""

    name: str
    feet: dict[str, FootTruth]
    strides: list[TruthStride]
    activities: list[Activity] = field(default_factory=list)
    reference: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))

    def __repr__(self) -> str:
        return f"Truth {self.name}: {len(self.strides)} strides of {', '.join(self.feet) or 'no foot'}"

    def strides_of(self, foot: str) -> list[TruthStride]:
        """One foot's strides."""
        return [stride for stride in self.strides if stride.foot == foot]


_FROM_TEXT: dict[Any, Callable[[str], Any]] = {str: str, int: int, float: float, bool: lambda text: text == "yes"}
_PARTS = (("sensor_m", "xyz"), ("toe_m", "xyz"), ("heel_m", "xyz"), ("q_world_from_sensor", "wxyz"))


def write_truth(truth: Truth, folder: Path) -> list[Path]:
    """Write ``NAME.truth.parquet``, ``.strides.csv``, ``.activities.csv`` and, if there is one, ``.reference.csv``.

    Positions are kept to 0.1 mm, quaternions to 1e-5 (about 0.001°). Returns what was written; overwrites.
    """
    import pyarrow as pa
    from pyarrow import parquet

    first = next(iter(truth.feet.values()))
    columns: dict[str, Any] = {"t_ns": first.t_ns}
    for name, foot in truth.feet.items():
        for part, axes in _PARTS:
            values = np.round(getattr(foot, part), 5 if part.startswith("q_") else 4).astype(np.float32)
            for axis, letter in enumerate(axes):
                columns[f"{name}_{part}_{letter}"] = values[:, axis]
        columns[f"{name}_phase"] = foot.phase.astype(np.int8)
    written = [folder / f"{truth.name}.{kind}" for kind in ("truth.parquet", "strides.csv", "activities.csv")]
    split = [name for name in columns if name.startswith(tuple(truth.feet)) and not name.endswith("_phase")]
    packed = {"compression": "zstd", "compression_level": 12, "use_dictionary": False, "use_byte_stream_split": split}
    parquet.write_table(pa.table(columns), written[0], **packed)
    tables: list[tuple[type, Sequence[Any]]] = [(TruthStride, truth.strides), (Activity, truth.activities)]
    for path, (kind, items) in zip(written[1:], tables, strict=True):
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, [item.name for item in fields(kind)], lineterminator="\n")
            writer.writeheader()
            writer.writerows({key: _text(value) for key, value in asdict(item).items()} for item in items)
    if len(truth.reference):
        written.append(folder / f"{truth.name}.reference.csv")
        lines = [f"{t:.2f},{x:.4f},{y:.4f},{z:.4f}" for t, x, y, z in truth.reference]
        written[-1].write_text("\n".join(["t_s,x_m,y_m,z_m", *lines]) + "\n", encoding="utf-8")
    return written


def _text(value: object) -> object:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4f}" if isinstance(value, float) else value


def load_truth(path: Path) -> Truth:
    """Read the truth beside a recording, by the recording or any of its truth files.

    Raises:
        FileNotFoundError: a truth file is missing; the message names it and how to make it.
        ValueError: a truth file holds something else.
    """
    from pyarrow import parquet

    name = path.name.split(".", 1)[0]  # from any of its files
    files = [path.with_name(f"{name}.{kind}") for kind in ("truth.parquet", "strides.csv", "activities.csv")]
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(
                f"{file}: no such truth file; `python -m sim_inputs.generator.trials DIR` makes the bundled set"
            )
    table = parquet.read_table(files[0])
    t_ns = table.column("t_ns").to_numpy()
    feet = {}
    for foot in [column.removesuffix("_phase") for column in table.column_names if column.endswith("_phase")]:
        parts = {
            part: np.column_stack([table.column(f"{foot}_{part}_{letter}").to_numpy().astype(float) for letter in axes])
            for part, axes in _PARTS
        }
        feet[foot] = FootTruth(t_ns, phase=table.column(f"{foot}_phase").to_numpy().astype(np.int64), **parts)
    reference_file = path.with_name(f"{name}.reference.csv")
    reference = np.loadtxt(reference_file, delimiter=",", skiprows=1) if reference_file.is_file() else np.zeros((0, 4))
    return Truth(name, feet, _read_rows(TruthStride, files[1]), _read_rows(Activity, files[2]), reference)


def _read_rows(kind: type[Row], path: Path) -> list[Row]:
    """A CSV's rows by the types of a dataclass."""
    types, out = get_type_hints(kind), []
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            values = {}
            for name, of in types.items():
                if row.get(name) is None:
                    raise ValueError(f"{path}: column {name!r} is missing")
                try:
                    values[name] = _FROM_TEXT[of](row[name])
                except ValueError as error:
                    raise ValueError(f"{path}: {name} = {row[name]!r} is not a number") from error
            out.append(kind(**values))
    return out
