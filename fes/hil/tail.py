"""A simulated stimulator's record, read on from where it was read before."""

from __future__ import annotations

import json
from pathlib import Path

from drivers.virtual.node_record import RecordEntry


class RecordTail:
    """Reads a growing record; each line is read once, a line without its end only when that has come."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0
        self._begun = b""
        self._lines = 0

    def news(self) -> list[RecordEntry]:
        """The entries since the last call; none as long as there is no file.

        Raises:
            ValueError: a line is no record entry; names file and line.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read()
        except FileNotFoundError:
            return []
        self._at += len(data)
        *lines, self._begun = (self._begun + data).split(b"\n")
        entries = []
        for line in lines:
            self._lines += 1
            try:
                entries.append(RecordEntry(**json.loads(line)))
            except (ValueError, TypeError) as error:
                raise ValueError(f"{self._path}:{self._lines}: is no entry of a record: {error}") from error
        return entries
