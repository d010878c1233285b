"""Which recordings a cohort is made of: paths, globs and addresses on any storage that fsspec opens."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

import fsspec

from fes.cohort.beside import LARGEST_SIDECAR, SIDECAR, fetch, mark_beside, mark_of_info, sidecar_of
from fes.cohort.program import program
from fes.recording.read import CAN_SUFFIXES, TABLE_SUFFIXES

SUFFIXES: Final = TABLE_SUFFIXES + CAN_SUFFIXES


class CohortError(RuntimeError):
    """The cohort cannot be worked on; the message says what to do."""


@dataclass(frozen=True, slots=True)
class Source:
    """One recording's data file, as found.

    Attributes:
        url: with its protocol; what a worker opens.
        mark: size and time or tag of the data file, as the storage tells; what is in its sidecar; and size and time of
            all that the sidecar names. Another file, another mark.
        program: that was asked to work on it; a worker takes the asker's word.
    """

    url: str
    mark: str
    program: str = field(default_factory=program)

    @property
    def path(self) -> PurePosixPath:
        """Without protocol and archive."""
        return PurePosixPath(re.sub(r"^\w+://", "", self.url.split("::", 1)[0]))

    def identity(self, settings: str) -> str:
        """The name of this recording's results: the same for the same files, settings and program."""
        text = "\n".join((self.url, self.mark, settings, self.program))
        return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:20]  # of names that are no UTF-8

    def subject(self, pattern: str) -> str:
        """What ``pattern`` (its group ``subject``, or its first) finds in the address; "" where it finds nothing."""
        found = re.search(pattern, self.url) if pattern else None
        if found is None:
            return ""
        return found.groupdict().get("subject") or (found.group(1) if found.groups() else found.group(0)) or ""


def find(patterns: Sequence[str], beside: Sequence[str] = ()) -> list[Source]:
    """All recordings below folders, matching globs or named, each once, in the order of their addresses.

    In folders and globs only files that have a sidecar beside them count; a file that is named outright always does,
    so that a missing sidecar is told. ``beside``: endings of files of the same name that results rest on too.

    Raises:
        CohortError: a storage cannot be opened, or nothing is found.
    """
    found: dict[str, Source] = {}
    for pattern in patterns:
        try:
            filesystem, path = fsspec.core.url_to_fs(pattern)
            for source in _below(filesystem, path, pattern, tuple(beside)):
                found.setdefault(source.url, source)
        except Exception as error:  # storages have errors of their own: no rights, no such account, no package
            raise CohortError(f"{pattern}: cannot be opened: {str(error) or type(error).__name__}") from error
    if not found:
        raise CohortError(
            f"{', '.join(patterns)}: no recording ({', '.join(SUFFIXES)}, each with its sidecar {SIDECAR}) is there."
        )
    return [found[url] for url in sorted(found)]


def _below(filesystem: Any, path: str, pattern: str, endings: tuple[str, ...]) -> Iterator[Source]:
    named = not any(mark in path for mark in "*?[") or filesystem.exists(path)  # a folder may be called "a[1]"
    outright = named and filesystem.isfile(path)
    if outright:
        infos = {path: filesystem.info(path)}
    else:
        infos = filesystem.find(path, detail=True) if named else filesystem.glob(path, detail=True)
    names = [
        name
        for name, info in infos.items()
        if outright or (info.get("type") != "directory" and PurePosixPath(name).suffix.lower() in SUFFIXES)
    ]
    for name in names:
        sidecar = sidecar_of(name)
        if sidecar not in infos and filesystem.isfile(sidecar):
            infos[sidecar] = filesystem.info(sidecar)
    sidecars = _texts(filesystem, {sidecar: infos[sidecar] for sidecar in map(sidecar_of, names) if sidecar in infos})
    for name in names:
        sidecar = sidecar_of(name)
        if sidecar in infos or outright:
            mark = mark_of_info(infos[name]) + mark_beside(filesystem, name, sidecars.get(sidecar), infos, endings)
            yield Source(_url(filesystem, name, pattern), mark)


def _texts(filesystem: Any, infos: dict[str, Any]) -> dict[str, bytes]:
    """What is in these files, all asked for at once; those that are too long or cannot be read are left out."""
    # neither a pipe nor a device, which have no end
    plain = [path for path, info in infos.items() if info.get("type") == "file" or filesystem.isfile(path)]
    paths = [path for path in plain if (infos[path].get("size") or 0) <= LARGEST_SIDECAR]
    texts = filesystem.cat_ranges(paths, None, None, on_error="return") if paths else []
    return {path: text for path, text in zip(paths, texts, strict=True) if isinstance(text, bytes)}


def _url(filesystem: Any, path: str, pattern: str) -> str:
    """The address of one file; a chained one (``zip://…::archive``) keeps its archive."""
    if "::" in pattern:
        head, _, rest = pattern.partition("::")
        return f"{head.split('://', 1)[0]}://{path.lstrip('/')}::{rest}"
    return str(filesystem.unstrip_protocol(path))


@contextmanager
def local_copy(source: Source, beside: Sequence[str] = ()) -> Iterator[Path]:
    """The recording as a file here, with its sidecar and what that names, for as long as it is needed.

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
            yield fetch(filesystem, path, Path(folder), tuple(beside))
    except OSError as error:
        raise CohortError(f"{source.url}: cannot be fetched: {error}") from error


def _protocols(filesystem: Any) -> tuple[str, ...]:
    protocol = filesystem.protocol
    return (protocol,) if isinstance(protocol, str) else tuple(protocol)
