"""The text that Xsens' MT Manager exports of one sensor: remark lines, a line of column names, tabs, a row a packet.

Packets are numbered by a 16-bit counter that all sensors of a station share; a lost packet is a number that is missing,
or a row without values. Accelerations are in m/s², rates in rad/s.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fes.datasets.common import ImportProblem
from fes.signals import FloatArray, IntArray

WRAP: Final = 65536
COLUMNS: Final = ("PacketCounter", *(f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ"))


@dataclass(frozen=True, eq=False)
class XsensText:
    """One sensor: ``device`` as the file names it (upper case), ``rate_hz`` None where the file does not say.

    ``counter`` (N,) goes on where the 16 bits wrap; ``acc_mps2`` and ``gyr_radps`` are (N, 3).
    """

    device: str
    rate_hz: float | None
    counter: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray


def read_xsens_text(path: Path) -> XsensText:
    """Read one sensor's file.

    Raises:
        ImportProblem: it is no such file; the message names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImportProblem(f"{path}: cannot be read: {error}") from error
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("//")), len(lines))
    names = lines[first].split("\t") if first < len(lines) else []
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise ImportProblem(
            f"{path}: is no text export of MT Manager with calibrated data: it lacks the columns {', '.join(missing)}"
        )
    at = [names.index(name) for name in COLUMNS]
    counts, rows = [], []
    for number, line in enumerate(lines[first + 1 :], first + 2):
        cells = line.split("\t")
        if not line.strip() or (len(cells) == len(names) and not any(cells[k].strip() for k in at[1:])):
            continue  # a lost packet
        try:
            values = [float(cells[k]) for k in at]
            counts.append(int(values[0]))
        except (ValueError, IndexError, OverflowError):
            raise ImportProblem(f"{path}:{number}: holds no packet of {len(names)} columns; is the file cut?") from None
        rows.append(values[1:])
    table = np.array(rows, np.float64).reshape(-1, 6)
    counter = np.array(counts, np.int64)
    wrapped = np.concatenate([[0], np.cumsum(np.diff(counter) < -WRAP // 2)]) if len(counter) else counter
    counter = counter + WRAP * wrapped
    back = np.flatnonzero(np.diff(counter) <= 0)
    if len(back):
        raise ImportProblem(f"{path}: its PacketCounter does not increase after packet {int(counter[back[0]]) % WRAP}")
    remarks = "\n".join(lines[:first])
    device = re.search(r"DeviceId:\s*([0-9A-Fa-f]+)", remarks)
    rate = re.search(r"(?:Update|Output|Sample)\s*[Rr]ate:?\s*([0-9.]+)\s*Hz", remarks)
    name = device[1] if device else path.stem.rsplit("_", 1)[-1]
    return XsensText(name.upper(), float(rate[1]) if rate else None, counter, table[:, :3], table[:, 3:])
