"""``jit``: numba's compiler, and where compiled code is kept between processes.

numba decides by a file's time stamp whether its cached machine code is still good, and does not see a change in a
function that the file calls. So compiled code is kept in a folder named by a digest of all the sources that are
compiled together.

numba's cache files are not safe to share either: two processes that compile one function for different types at once
mix up their code, and a file that a power cut has left short ends the program. So each process has a cache folder of
its own, made of links to the kept files, and adds what it has compiled to these when it ends (:class:`KeptCode`).
Only numba's documented interface is used.
"""

from __future__ import annotations

import atexit
import errno
import fcntl
import hashlib
import json
import logging
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba

import fes.signals

Function = TypeVar("Function", bound=Callable[..., Any])

LEAST_FREE_BYTES = 32_000_000  # all compiled code takes a third of that
_NUMBERED = re.compile(r"(\.\d+)?\.nb[ic]$")  # what tells numba's files of one function apart

_functions: list[Any] = []
_warned: list[Exception] = []


class KeptCode:
    """The compiled code that is kept in a folder, and this process's own copy of it, which numba works on.

    ``kept.json`` lists the kept files with their sizes. It is replaced in one step once they are written through to the
    disk, and a file that is not in it, or is not as long as it says, is never used: so nothing that a power cut leaves
    is. Code of a function is taken over and added as a whole; where two processes have added to the same function, the
    first one's stays, and what the other compiled is compiled again when it is next needed. A forked child has its
    parent's folder: it must not compile what its siblings compile.
    """

    def __init__(self, root: Path) -> None:
        self.root, self._kept, self._list = root, root / "kept", root / "kept.json"
        self._seen: dict[str, tuple[object, object]] = {}  # by function: its index here and there, as fetched
        self._pid = os.getpid()
        self.own: Path
        with self._locked():
            for other in root.glob("process-*"):
                if not _is_alive(other):
                    shutil.rmtree(other, ignore_errors=True)
            self.own = Path(tempfile.mkdtemp(prefix="process-", dir=root))
            self._alive = (self.own / "alive").open("w")  # locked for as long as this process lives
            fcntl.flock(self._alive, fcntl.LOCK_EX)
            self._link()

    def is_empty(self) -> bool:
        """Whether nothing has been kept yet."""
        return not self._listed()

    def fetch(self) -> None:
        """Take over what other processes have added since, of functions that this one has not compiled itself."""
        with self._locked():
            self._link()

    def keep(self) -> None:
        """Add what this process has compiled.

        Raises:
            OSError: it cannot be written.
        """
        with self._locked():
            listed, added = self._listed(), []
            intact = self._intact(listed)
            for index in self.own.rglob("*.nbi"):
                name = str(index.relative_to(self.own))
                kept = self._kept / name
                own_before, kept_before = self._seen.get(name, (None, None))
                if _stamp(index) == own_before or (_stamp(kept) if name in intact else None) != kept_before:
                    continue  # nothing new, or another process was first
                kept.parent.mkdir(parents=True, exist_ok=True)
                code = index.parent.glob(f"{index.stem}.*.nbc")
                for file in (*code, index):  # last the index, which leads to the code
                    _write_through(file)
                    _copy(file, kept.with_name(file.name))
                    listed[str(file.relative_to(self.own))] = file.stat().st_size
                added.append(kept.parent)
                self._seen[name] = _stamp(index), _stamp(kept)
            if added:
                for folder in {*added, self._kept}:
                    _write_through(folder)
                new = self._list.with_suffix(".new")
                new.write_text(json.dumps(listed), encoding="utf-8")
                _write_through(new)
                new.replace(self._list)
                _write_through(self.root)

    def close(self) -> None:
        """Keep what was compiled, and remove this process's own folder."""
        if os.getpid() != self._pid:
            return
        keep_compiled()
        shutil.rmtree(self.own, ignore_errors=True)
        self._alive.close()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with (self.root / "lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _listed(self) -> dict[str, int]:
        try:
            listed: dict[str, int] = json.loads(self._list.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return listed

    def _intact(self, listed: dict[str, int]) -> dict[str, list[str]]:
        """The files of each function of which all are as long as listed, by the name of its index."""
        functions: dict[str, list[str]] = {}
        for name in listed:
            functions.setdefault(_NUMBERED.sub(".nbi", name), []).append(name)
        return {
            index: names
            for index, names in functions.items()
            if all(_size(self._kept / name) == listed[name] for name in names)
        }

    def _link(self) -> None:
        for index, names in self._intact(self._listed()).items():
            here = self.own / index
            if here.exists():
                continue
            here.parent.mkdir(exist_ok=True)
            for name in names:
                _copy(self._kept / name, self.own / name)
            self._seen[index] = _stamp(here), _stamp(self._kept / index)


def _stamp(file: Path) -> object:
    """What changes when a file is replaced; None without one."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return -1


def _copy(file: Path, target: Path) -> None:
    """Put another name for a file that nobody writes into (numba replaces files), or a copy, in the place of a file."""
    new = target.with_name(f"{target.name}.new")
    new.unlink(missing_ok=True)
    try:
        new.hardlink_to(file)
    except OSError:  # a file system without links
        shutil.copyfile(file, new)
        _write_through(new)
    new.replace(target)


def _write_through(path: Path) -> None:
    """Have the disk hold a file, or a folder's names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_alive(folder: Path) -> bool:
    """Whether the process is alive that a folder belongs to."""
    try:
        with (folder / "alive").open() as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _warn_unkept(error: Exception) -> None:
    """Say once that compiled code cannot be kept."""
    if not _warned:
        _warned.append(error)
        logging.getLogger(__name__).warning(
            "Compiled code cannot be kept, so the next start takes as long as this one: %s. Make room there, or name "
            "another folder in XDG_CACHE_HOME.", error
        )  # fmt: skip


def _sources() -> list[Path]:
    """All that compiled code may be made of: a constant's new value, too, is no change of the function that has it."""
    root = Path(__file__).parents[3]
    beside = ("fes/estimation", "fes/analysis", "fes/simulation/forward", "statemachine")
    found = [path for folder in beside for path in sorted((root / folder).rglob("*.py"))]
    return [*found, root / "fes/recording/kernels.py", Path(fes.signals.__file__)]


def _kept_code() -> KeptCode | None:
    """The kept code of this version; None where nothing can be kept."""
    digest = hashlib.sha256()
    for source in _sources():
        digest.update(source.read_bytes())
    name = digest.hexdigest()[:16]
    try:
        return _kept_in(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fes-gait" / name)
    except (OSError, RuntimeError):  # a read-only home, or none: compile once per boot instead of once per version
        try:
            own = Path(tempfile.gettempdir()) / f"fes-gait-{os.getuid()}"
            own.mkdir(exist_ok=True, mode=0o700)
            if own.stat().st_uid != os.getuid():  # anybody can make it, and what is in it would be run
                raise PermissionError(f"{own} belongs to somebody else")
            return _kept_in(own / name)
        except OSError as error:  # nor anything else: compile at every start
            _warn_unkept(error)
            return None


def _kept_in(root: Path) -> KeptCode:
    """Kept code in this folder; raises OSError where it cannot be written."""
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=root) as file:  # of a full disk folders and empty files say nothing
        file.write(b"0")
    if shutil.disk_usage(root).free < LEAST_FREE_BYTES:
        raise OSError(errno.ENOSPC, f"less than {LEAST_FREE_BYTES // 1_000_000} MB are free in {root}")
    return KeptCode(root)


_PLAIN: Final = bool(vars(numba.config)["DISABLE_JIT"])  # NUMBA_DISABLE_JIT: Python alone, to be read and compared
KEPT: Final = None if _PLAIN else _kept_code()
if KEPT is not None:
    setattr(numba.config, "CACHE_DIR", str(KEPT.own))  # noqa: B010 - numba fills its config at run time
    atexit.register(KEPT.close)


def keep_compiled() -> None:
    """Keep what has been compiled so far, whatever becomes of this process; else that is done at its end."""
    try:
        if KEPT is not None:
            KEPT.keep()
    except OSError as error:
        _warn_unkept(error)


def compiled_here() -> list[str]:
    """The functions that this process has had to compile, as nothing was kept of them."""
    names = (f"{each.__module__}.{each.__qualname__}" for each in _functions if sum(each.stats.cache_misses.values()))
    return [] if _PLAIN else sorted(names)


def signatures() -> int:
    """For how many kinds of arguments there is compiled code in this process."""
    return 0 if _PLAIN else sum(len(each.signatures) for each in _functions)


def _compiled(function: Function, **options: str | set[str]) -> Function:
    plain: Any = numba.njit
    made = plain(cache=KEPT is not None, nogil=True, **options)(function)
    _functions.append(made)
    return cast(Function, made)


def jit(function: Function) -> Function:
    """Compile for plain numbers and arrays: cached on disk, IEEE arithmetic in the order written, no GIL held."""
    return _compiled(function)


def inlined(function: Function) -> Function:
    """As :func:`jit`, for a few lines of arithmetic that become part of what calls them: no call that could fail."""
    return _compiled(function, inline="always")


def jit_ieee(function: Function) -> Function:
    """As :func:`jit`, but that x / 0 is infinite as in IEEE, and no error.

    Where nothing in a function can fail, neither a division nor a call, its arrays need not be counted in and out: a
    locked instruction for each of them, which costs more than the arithmetic of one step of a filter.
    """
    return _compiled(function, error_model="numpy")


def jit_fused(function: Function) -> Function:
    """As :func:`jit_ieee`, but that where the processor can, a product and a sum are rounded once instead of twice.

    Filters take up to a quarter less time so. Not for the live core, which is compiled both for one sample and for a
    block: which products are fused is the compiler's choice at each place, and these two have to agree to the bit.
    """
    return _compiled(function, error_model="numpy", fastmath={"contract"})
