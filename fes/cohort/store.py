"""The cohort's results as a Parquet data set: ``strides/``, ``events/`` and ``recordings/``, one part a recording.

A recording's row in ``recordings/`` is written last, in one step: it being there says that all of the recording is.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from secrets import token_hex
from typing import Any, Final

import fsspec
import pyarrow as pa
from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from pyarrow import parquet

from fes.cohort.sources import CohortError
from fes.estimation.strides.schema import TABLE
from fes.report.text import number

RECORDINGS: Final = "recordings"
STRIDES: Final = "strides"
EVENTS: Final = "events"
ABOUT: Final = "cohort.json"

_TEXT, _NUMBER, _COUNT = pa.string(), pa.float64(), pa.int64()
_KINDS: Final = {str: _TEXT, float: _NUMBER, int: _COUNT, bool: pa.bool_()}
_OF: Final = [("recording", _TEXT), ("subject", _TEXT), ("foot", _TEXT)]


def _numbers(*names: str) -> list[tuple[str, pa.DataType]]:
    return [(name, _NUMBER) for name in names]


SCHEMAS: Final[Mapping[str, pa.Schema]] = {
    RECORDINGS: pa.schema(
        [
            *[
                (name, _TEXT)
                for name in (
                    "recording",
                    "source",
                    "name",
                    "subject",
                    "group",
                    "status",
                    "reason",
                    "fes_version",
                    "findings",
                )
            ],
            *[(name, _COUNT) for name in ("samples", "missing", "clipped", "irregular", "strides", "valid_strides")],
            *_numbers("duration_s", "belt_speed_mps", "stride_length_m", "speed_mps", "stride_time_s", "clearance_m"),
            *_numbers("cadence_per_min", "step_time_s", "swing_symmetry_percent", "step_time_symmetry_percent"),
            *_numbers("stride_time_cv_percent", "stride_length_cv_percent"),
        ]
    ),
    STRIDES: pa.schema([*_OF[:2], *((column.name, _KINDS[column.kind]) for column in TABLE)]),
    EVENTS: pa.schema(
        [
            *_OF,
            *_numbers("t_foot_off_s", "t_mid_swing_s", "t_initial_contact_s"),
            *_numbers("t_foot_off_live_s", "t_initial_contact_live_s", "foot_strike_angle_rad"),
        ]
    ),
}


@dataclass(frozen=True, slots=True)
class Measure:
    """A column that pages and tables show; ``best`` is which end of it is good, 0 where neither is."""

    name: str
    title: str
    unit: str = ""
    best: int = 0
    digits: int = 1
    factor: float = 1.0

    @property
    def axis(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def text(self, value: float | None) -> str:
        """An SI value in this unit; a dash where it is unknown."""
        return number(None if value is None else self.factor * value, self.digits)


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of results on any storage that fsspec opens.

    Args:
        url: of the folder.
        schemas: of its tables, by name.
        last: the table that is written last and says what is finished.
    """

    url: str
    schemas: Mapping[str, pa.Schema] = field(default_factory=lambda: SCHEMAS)
    last: str = RECORDINGS

    def prepare(self, about: Mapping[str, Any]) -> None:
        """Make the folder and say what is in it. CohortError: it cannot be written."""
        filesystem, root = self._open()
        try:
            for table in self.schemas:
                filesystem.makedirs(f"{root}/{table}", exist_ok=True)
            with filesystem.open(f"{root}/{ABOUT}", "wb") as file:
                file.write(json.dumps(about, indent=1, ensure_ascii=False).encode(errors="backslashreplace") + b"\n")
        except CohortError:
            raise
        except Exception as error:  # storages have errors of their own; some cannot be written to at all
            why = str(error) or f"{type(error).__name__}; this storage may be for reading only"
            raise CohortError(f"{self.url}: cannot be written: {why}. Choose another with --out.") from error

    def put(self, identity: str, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
        """Keep one piece of work's rows; those of the last table last, so that a crash leaves it to be done again.

        OSError: the storage is full or gone.
        """
        filesystem, root = self._open()
        for table in sorted(tables, key=lambda name: name == self.last):
            listed = [dict(row) for row in tables[table]]
            try:
                rows = pa.Table.from_pylist(listed, schema=self.schemas[table])
            except UnicodeEncodeError:
                listed = [{key: _plain(value) for key, value in row.items()} for row in listed]
                rows = pa.Table.from_pylist(listed, schema=self.schemas[table])
            # a draft of its own: a scheduler that thinks a worker lost has its work done twice at the same time
            draft, path = f"{root}/{table}/.{identity}.{token_hex(4)}.part", f"{root}/{table}/{identity}.parquet"
            whole = pa.BufferOutputStream()  # written at once: through a Python file every piece costs a call
            parquet.write_table(rows, whole, write_page_checksum=True)
            _replace(filesystem, draft, path, whole.getvalue())

    def finished(self) -> set[str]:
        """What is complete, by identity."""
        filesystem, root = self._open()
        folder = f"{root}/{self.last}"
        if not filesystem.isdir(folder):
            return set()
        listed = filesystem.ls(folder, detail=True, refresh=True)
        # a power cut may leave a name without its bytes
        names = (str(each["name"]).rsplit("/", 1)[-1] for each in listed if each.get("size") != 0)
        return {name.removesuffix(".parquet") for name in names if name.endswith(".parquet")}

    def forget(self, identities: Iterable[str]) -> None:
        """Take these recordings' rows away, so that they are done again."""
        self._remove(identities, [self.last])

    def remove(self, identities: Iterable[str]) -> None:
        """Take all rows of these away; those of the last table last, so that a crash on the way leaves them known.

        OSError: the storage does not let it.
        """
        self._remove(identities, sorted(self.schemas, key=lambda name: name == self.last))

    def _remove(self, identities: Iterable[str], tables: Sequence[str]) -> None:
        filesystem, root = self._open()
        for identity in identities:
            for table in tables:
                with suppress(FileNotFoundError):
                    filesystem.rm_file(f"{root}/{table}/{identity}.parquet")

    def table(self, name: str, identities: Iterable[str], columns: Sequence[str] | None = None) -> pa.Table:
        """The rows of these recordings, with all columns or some; leftovers of other runs are not among them."""
        filesystem, root = self._open()
        folder = f"{root}/{name}"
        listed = filesystem.ls(folder, detail=False, refresh=True) if filesystem.isdir(folder) else ()
        there = {str(path).rsplit("/", 1)[-1] for path in listed}
        paths = [f"{folder}/{identity}.parquet" for identity in sorted(identities) if f"{identity}.parquet" in there]
        if not paths:
            empty = self.schemas[name].empty_table()
            return empty if columns is None else empty.select(list(columns))
        how: dict[str, Any] = {"schema": self.schemas[name], "filesystem": filesystem}
        how["page_checksum_verification"] = True
        try:
            return parquet.read_table(paths, columns=None if columns is None else list(columns), **how)
        except FileNotFoundError:
            raise
        except (pa.ArrowException, OSError) as error:
            for path in paths:
                try:
                    parquet.read_table(path, **how)
                except (pa.ArrowException, OSError):
                    file = path.rsplit("/", 1)[-1]
                    raise CohortError(
                        f"{self.place(name)}/{file}: is damaged: {error}. Delete {self.place(self.last)}/{file} and "
                        f"run the same command again: what it belongs to is done again."
                    ) from error
            raise

    def write(self, name: str, data: str | bytes) -> None:
        """Write a page or a file beside the tables."""
        filesystem, root = self._open()
        filesystem.makedirs(f"{root}/{name}".rsplit("/", 1)[0], exist_ok=True)
        with filesystem.open(f"{root}/{name}", "wb") as file:
            file.write(data.encode() if isinstance(data, str) else data)

    def place(self, name: str) -> str:
        """Where a page or table is, for people."""
        return f"{self.url.rstrip('/')}/{name}"

    def _open(self) -> tuple[AbstractFileSystem, str]:
        try:
            filesystem, root = fsspec.core.url_to_fs(self.url)
        except (ValueError, ImportError, OSError) as error:
            raise CohortError(f"{self.url}: no storage for the results: {error}") from error
        return filesystem, str(root).rstrip("/")


def _plain(value: object) -> object:
    """Text that every file takes: bytes of a name that are no UTF-8 as escapes."""
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


def _replace(filesystem: AbstractFileSystem, draft: str, path: str, data: pa.Buffer) -> None:
    """Write a file in one step: whoever looks at ``path`` finds all of it, or what was there before."""
    if isinstance(filesystem, LocalFileSystem):  # whose move copies where it cannot rename
        here = Path(draft)
        try:
            here.write_bytes(data)
            here.replace(path)
        except OSError:
            here.unlink(missing_ok=True)  # it would take what little room there is
            raise
        return
    with filesystem.open(draft, "wb") as file:
        file.write(data)
    filesystem.mv(draft, path)
