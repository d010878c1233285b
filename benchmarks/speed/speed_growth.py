"""How the analysis grows with the recording: time an hour and greatest memory of `fes analyse`, file to tables, each
length in a process of its own."""

from __future__ import annotations

import sys
from pathlib import Path

import pyarrow as pa
from pyarrow import compute, parquet

from benchmarks.speed.speed import one_walk, repeated
from benchmarks.speed.speed_row import Row
from benchmarks.speed.speed_session import spent_by
from fes.recording import Recording, write_recording

GROUP = "growth with the recording"
LINEAR, BOUNDED = 1.25, 1.5


def write_long(walk: Recording, hours: float, path: Path) -> tuple[int, float]:
    """A recording of about that length as a file, written in pieces; samples of all feet together, hours in truth."""
    piece = repeated(walk, 10.0)
    write_recording(piece, path, overwrite=True)
    table = parquet.read_table(path)
    stamps = [name for name in table.column_names if pa.types.is_integer(table.schema.field(name).type)]
    span_ns = max(int(track.t_ns[-1] - track.t_ns[0]) for track in piece.tracks.values())
    span_ns += round(1e9 / next(iter(piece.tracks.values())).rate_hz)
    times = max(round(3.6e12 * hours / span_ns), 1)
    with parquet.ParquetWriter(path, table.schema) as writer:
        for number in range(times):
            later = table
            for name in stamps:
                column = compute.add(table.column(name), number * span_ns)
                later = later.set_column(later.column_names.index(name), table.schema.field(name), column)
            writer.write_table(later)
    return times * sum(len(track.t_ns) for track in piece.tracks.values()), times * span_ns / 3.6e12


def growth_rows(lengths: list[float], folder: Path) -> list[Row]:
    """Time and memory of each length, and how they grow from the shortest to the longest."""
    fes, walk = Path(sys.executable).with_name("fes"), one_walk()
    rows, spent = [], {}
    write_long(walk, 0.2, folder / "warm.parquet")
    spent_by([fes, "analyse", folder / "warm.parquet", "--out", folder / "out", "--no-report"])  # compiles, if need be
    for asked in sorted(lengths):
        path = folder / f"walk_{asked:g}h.parquet"
        samples, hours = write_long(walk, asked, path)
        command = [fes, "analyse", path, "--out", folder / "out", "--format", "parquet", "--no-report"]
        spent[hours] = spent_by(command)
        path.unlink()
        note = f"{samples / 1e6:.2f} M samples"
        rows.append(Row(GROUP, f"fes analyse, {hours:.2g} h", spent[hours].seconds, "s", note=note))
        rows.append(Row(GROUP, f"memory, {hours:.2g} h", spent[hours].memory_mb, "MB"))
    if len(spent) > 1:
        short, long = min(spent), max(spent)
        times = (spent[long].seconds / long) / (spent[short].seconds / short)
        what = f"time an hour, {long:.2g} h over {short:.2g} h"
        rows.append(Row(GROUP, what, times, "", LINEAR, note="linear: 1, less by what starting takes"))
        memory = spent[long].memory_mb / spent[short].memory_mb
        rows.append(Row(GROUP, f"memory, {long:.2g} h over {short:.2g} h", memory, "", BOUNDED))
    return rows
