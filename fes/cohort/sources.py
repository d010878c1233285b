"""Which recordings a cohort is made of: paths, globs and addresses on any storage that fsspec opens."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import fsspec

from fes import __version__
from fes.recording.read import CAN_SUFFIXES, TABLE_SUFFIXES

SUFFIXES: Final = TABLE_SUFFIXES + CAN_SUFFIXES
SIDECAR: Final = ".toml"


class CohortError(RuntimeError):
    """The cohort cannot be worked on; the message says what to do."""


@dataclass(frozen=True, slots=True)
class Source:
    """One recording's data file, as found.

    Attributes:
        url: with its protocol; what a worker opens.
        mark: size and time or tag of the data file and its sidecar, as the storage tells: another file, another mark.
    """

    url: str
    mark: str

    @property
    def path(self) -> PurePosixPath:
        """Without protocol and archive."""
        return PurePosixPath(re.sub(r"^\w+://", "", self.url.split("::", 1)[0]))

    def identity(self, settings: str) -> str:
        """The name of this recording's results: the same for the same files, settings and version of this program."""
        text = "\n".join((self.url, self.mark, settings, __version__))
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def subject(self, pattern: str) -> str:
        """What ``pattern`` (its group ``subject``, or its first) finds in the address; "" where it finds nothing."""
        found = re.search(pattern, self.url) if pattern else None
        if found is None:
            return ""
        return str(found.groupdict().get("subject") or (found.group(1) if found.groups() else found.group(0)))


def find(patterns: Sequence[str]) -> list[Source]:
    """All recordings below folders, matching globs or named, each once, in the order of their addresses.

    In folders and globs only files that have a sidecar beside them count; a file that is named outright always does,
    so that a missing sidecar is told.

    Raises:
        CohortError: a storage cannot be opened, or nothing is found.
    """
    found: dict[str, Source] = {}
    for pattern in patterns:
        try:
            filesystem, path = fsspec.core.url_to_fs(pattern)
            for source in _below(filesystem, path, pattern):
                found.setdefault(source.url, source)
        except (OSError, ValueError, ImportError) as error:
            raise CohortError(f"{pattern}: cannot be opened: {error}") from error
    if not found:
        raise CohortError(
            f"{', '.join(patterns)}: no recording ({', '.join(SUFFIXES)}, each with its sidecar {SIDECAR}) is there."
        )
    return [found[url] for url in sorted(found)]


def _below(filesystem: Any, path: str, pattern: str) -> Iterator[Source]:
    named = not any(mark in path for mark in "*?[")
    if named and filesystem.isfile(path):
        sidecar = _sidecar(path)
        mark = _mark(filesystem.info(path))
        yield Source(
            _url(filesystem, path, pattern),
            mark + (_mark(filesystem.info(sidecar)) if _has(filesystem, sidecar) else ""),
        )
        return
    infos = filesystem.find(path, detail=True) if named else filesystem.glob(path, detail=True)
    for name, info in infos.items():
        if info.get("type") == "directory" or PurePosixPath(name).suffix.lower() not in SUFFIXES:
            continue
        beside = infos.get(_sidecar(name))
        if beside is None and _has(filesystem, _sidecar(name)):
            beside = filesystem.info(_sidecar(name))
        if beside is not None:
            yield Source(_url(filesystem, name, pattern), _mark(info) + _mark(beside))


def _has(filesystem: Any, path: str) -> bool:
    return bool(filesystem.isfile(path))


def _sidecar(path: str) -> str:
    return str(PurePosixPath(path).with_suffix(SIDECAR))


def _mark(info: dict[str, Any]) -> str:
    told = [
        info.get(key) for key in ("size", "mtime", "ETag", "etag", "LastModified", "last_modified", "date_time", "CRC")
    ]
    return "|".join(str(value) for value in told if value is not None) + ";"


def _url(filesystem: Any, path: str, pattern: str) -> str:
    """The address of one file; a chained one (``zip://…::archive``) keeps its archive."""
    if "::" in pattern:
        head, _, rest = pattern.partition("::")
        return f"{head.split('://', 1)[0]}://{path.lstrip('/')}::{rest}"
    return str(filesystem.unstrip_protocol(path))


@contextmanager
def local_copy(source: Source, beside: Sequence[str] = ()) -> Iterator[Path]:
    """The recording as a file here, with its sidecar beside it, for as long as it is needed.

    ``beside``: endings of further files of the same name that come too where they are there, as ``.strides.csv``.

    Raises:
        CohortError: it is gone, or the storage does not answer.
    """
    try:
        filesystem, path = fsspec.core.url_to_fs(source.url)
        if "file" in _protocols(filesystem):
            yield Path(path)
            return
        with tempfile.TemporaryDirectory(prefix="fes-cohort-") as folder:
            here = Path(folder) / PurePosixPath(path).name
            filesystem.get_file(path, str(here))
            for ending in (SIDECAR, *beside):
                other = str(PurePosixPath(path).with_suffix(ending))
                if _has(filesystem, other):
                    filesystem.get_file(other, str(here.with_suffix(ending)))
            yield here
    except OSError as error:
        raise CohortError(f"{source.url}: cannot be fetched: {error}") from error


def _protocols(filesystem: Any) -> tuple[str, ...]:
    protocol = filesystem.protocol
    return (protocol,) if isinstance(protocol, str) else tuple(protocol)
