"""A reference's file by its suffix, and several files as one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from fes.reference.csv_file import read_csv
from fes.reference.types import Reference, ReferenceError

TABLES = ("events", "strides", "path", "reference", "belt", "mat", "switch", "orientation", "end")
BESIDE = (*(f".{kind}.csv" for kind in TABLES), ".c3d")


def read_references(
    paths: Iterable[Path],
    *,
    foot: str | None = None,
    markers: Mapping[str, tuple[str, str]] | None = None,
    up: str = "z",
) -> Reference:
    """Read files and join them.

    Args:
        paths: CSV or C3D.
        foot: whose a table without a column for it is.
        markers: C3D: label → (foot, point); without it the usual labels.
        up: C3D: the laboratory's vertical axis, x, y or z.

    Raises:
        ReferenceError: one cannot be used, or two say the same thing.
    """
    whole = Reference()
    for path in map(Path, paths):
        suffix = path.suffix.lower()
        if suffix == ".c3d":
            from fes.reference.c3d_file import read_c3d

            part = read_c3d(path, markers=markers, up=up)
        elif suffix in (".csv", ".txt", ".tsv"):
            part = read_csv(path, foot=foot)
        else:
            raise ReferenceError(f"{path}: references are .csv or .c3d files, not {suffix or 'files without a suffix'}")
        whole = whole.joined(part)
    return whole


def beside(recording: Path) -> list[Path]:
    """The references that lie beside a recording under its name, as `fes import` writes them."""
    stem = recording.name.split(".", 1)[0]
    return [path for suffix in BESIDE if (path := recording.with_name(stem + suffix)).is_file()]
