"""``jit``: numba's compiler, and where compiled code is kept between processes.

numba decides by a file's time stamp whether its cached machine code is still good, and does not see a change in a
function that the file calls. So compiled code is kept in a folder named by a digest of all the sources that are
compiled together.

numba's cache files are not safe to share either: two processes that compile one function for different types at once
mix up their code, and a file that a power cut has left short ends the program. So each process has a cache folder of
its own, made of links to the kept files, and adds what it has compiled to these when it ends (:class:`KeptCode`).
Only numba's documented interface is used.

Without numba, the extra ``fast``, the same functions run as they are written, in plain Python.
"""

import atexit
import errno
import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final, TypeVar, cast

import numpy as np

import fes.signals

try:
    from fcntl import LOCK_EX, LOCK_NB, flock
except ImportError:  # Windows
    import errno
    import msvcrt
    import os

    def lock(file: IO[str], *, wait: bool = True) -> None:
        """As below, on the first byte, which need not be there."""
        mode = getattr(msvcrt, "LK_LOCK" if wait else "LK_NBLCK")
        while True:
            os.lseek(file.fileno(), 0, os.SEEK_SET)
            try:
                getattr(msvcrt, "locking")(file.fileno(), mode, 1)  # noqa: B009 - typed on Windows alone
                return
            except OSError as error:
                if not wait and error.errno == errno.EACCES:
                    raise BlockingIOError(*error.args) from error
                if error.errno != errno.EDEADLK:  # what it says after ten seconds of waiting
                    raise

else:

    def lock(file: IO[str], *, wait: bool = True) -> None:
        """Lock a file against other processes.

        Raises:
            BlockingIOError: another process has it, and ``wait`` is False.
            OSError: this file system has no locks.
        """
        flock(file, LOCK_EX if wait else LOCK_EX | LOCK_NB)


numba: Any
try:
    import numba
except ImportError:
    numba = None

Function = TypeVar("Function", bound=Callable[..., Any])

LEAST_FREE_BYTES = 32_000_000  # all compiled code takes a third of that
_NO_FILE = (0, 0, -1)

_functions: list[Any] = []
_warned: list[Exception] = []


class KeptCode:
    """The compiled code that is kept in a folder, and this process's own copy of it, which numba works on.

    ``kept.json`` lists the kept files of every function with their sizes, by the name of numba's index of them. It is
    replaced in one step once they are written through to the disk, and a function of which a file is not in it, or is
    not as long as it says, is never used: so nothing that a power cut leaves is. Code of a function is taken over and
    added as a whole; where two processes have added to the same function, the first one's stays, and what the other
    compiled is compiled again when it is next needed. A forked child has its parent's folder: it must not compile what
    its siblings compile.
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
            lock(self._alive)
        self.fetch()

    def is_empty(self) -> bool:
        """Whether nothing has been kept yet."""
        return not self._listed()

    def fetch(self) -> None:
        """Take over what other processes have added since, of functions that this one has not compiled itself."""
        with self._locked():
            for index, sizes in self._listed().items():
                here = self.own / index
                if not here.exists() and self._is_intact(sizes):
                    here.parent.mkdir(exist_ok=True)
                    for name in sizes:
                        _put(f"{self._kept}/{name}", f"{self.own}/{name}")
                    self._seen[index] = _stamp(here), _stamp(self._kept / index)

    def keep(self) -> None:
        """Add what this process has compiled.

        Raises:
            OSError: it cannot be written.
        """
        with self._locked():
            listed, changed = self._listed(), set[Path]()
            for own in self.own.rglob("*.nbi"):
                index = str(own.relative_to(self.own))
                kept = self._kept / index
                own_before, kept_before = self._seen.get(index, (_NO_FILE, _NO_FILE))
                kept_now = _stamp(kept) if index in listed and self._is_intact(listed[index]) else _NO_FILE
                if _stamp(own) == own_before or kept_now != kept_before:
                    continue  # nothing new, or another process was first
                kept.parent.mkdir(parents=True, exist_ok=True)
                listed[index] = {}
                for file in (*own.parent.glob(f"{own.stem}.*.nbc"), own):  # last the index, which leads to the code
                    _write_through(file)
                    _put(str(file), str(kept.with_name(file.name)))
                    listed[index][str(file.relative_to(self.own))] = file.stat().st_size
                changed |= {kept.parent, self._kept}
                self._seen[index] = _stamp(own), _stamp(kept)
            if changed:
                for folder in changed:
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
            lock(file)
            yield

    def _listed(self) -> dict[str, dict[str, int]]:
        try:
            listed: dict[str, dict[str, int]] = json.loads(self._list.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return listed

    def _is_intact(self, sizes: dict[str, int]) -> bool:
        return all(_stamp(self._kept / name)[2] == size for name, size in sizes.items())


def _stamp(file: Path) -> tuple[int, int, int]:
    """What changes when a file is replaced, last its size; ``_NO_FILE`` without one."""
    try:
        found = file.stat()
    except OSError:
        return _NO_FILE
    return found.st_ino, found.st_mtime_ns, found.st_size


def _put(file: str, target: str) -> None:
    """Put another name for a file that nobody writes into (numba replaces files), or a copy, in the place of a file."""
    if os.path.lexists(target):
        Path(target).unlink()
    try:
        os.link(file, target)
    except OSError:  # a file system without links
        new = Path(f"{target}.new")
        shutil.copyfile(file, new)
        _write_through(new)
        new.replace(target)


def _write_through(path: Path) -> None:
    """Have the disk hold a file, or a folder's names; Windows asks for a file opened to write, and opens no folder."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_alive(folder: Path) -> bool:
    """Whether the process is alive that a folder belongs to."""
    try:
        with (folder / "alive").open() as file:
            lock(file, wait=False)
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
    beside = ("fes/estimation", "fes/gate", "fes/analysis", "fes/simulation/forward", "statemachine")
    found = [path for folder in beside for path in sorted((root / folder).rglob("*.py"))]
    return [*found, Path(fes.signals.__file__)]


def _kept_code() -> KeptCode | None:
    """The kept code of this version; None where nothing can be kept."""
    name = hashlib.sha256(b"".join(source.read_bytes() for source in _sources())).hexdigest()[:16]
    try:
        return _kept_in(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fes-gait" / name)
    except (OSError, RuntimeError):  # a read-only home, or none: compile once per boot instead of once per version
        try:
            user = os.getuid() if hasattr(os, "getuid") else 0  # Windows: its folder is the user's alone, st_uid is 0
            own = Path(tempfile.gettempdir()) / f"fes-gait-{user}"
            own.mkdir(exist_ok=True, mode=0o700)
            if own.stat().st_uid != user:  # anybody can make it, and what is in it would be run
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


# Python alone: without numba, or with NUMBA_DISABLE_JIT, to be read and compared
PLAIN: Final = numba is None or bool(vars(numba.config)["DISABLE_JIT"])
KEPT: Final = None if PLAIN else _kept_code()
if KEPT is not None:
    setattr(numba.config, "CACHE_DIR", str(KEPT.own))  # noqa: B010 - numba fills its config at run time
    atexit.register(KEPT.close)


def keep_compiled() -> None:
    """Keep what has been compiled so far, whatever becomes of this process; else that is done at its end."""
    try:
        if KEPT is not None and compiled_here():
            KEPT.keep()
    except OSError as error:
        _warn_unkept(error)


def compiled_here() -> list[str]:
    """The functions that this process has had to compile, as nothing was kept of them."""
    missed = [] if PLAIN else [each for each in _functions if sum(each.stats.cache_misses.values())]
    return sorted(f"{each.__module__}.{each.__qualname__}" for each in missed)


def signatures() -> int:
    """For how many kinds of arguments there is compiled code in this process."""
    return 0 if PLAIN else sum(len(each.signatures) for each in _functions)


def _compiled(function: Function, **options: str | set[str]) -> Function:
    if PLAIN:
        return function
    made = numba.njit(cache=KEPT is not None, nogil=True, **options)(function)
    _functions.append(made)
    return cast("Function", made)


def _as_it_is(values: Any) -> Any:
    return values


literal_unroll: Final = _as_it_is if numba is None else numba.literal_unroll  # over a tuple of several types


def jit(function: Function) -> Function:
    """Compile for plain numbers and arrays: cached on disk, IEEE arithmetic in the order written, no GIL held."""
    return _compiled(function)


def inlined(function: Function) -> Function:
    """As :func:`jit`, for a few lines of arithmetic that become part of what calls them: no call that could fail."""
    return _compiled(function, inline="always")


def by_number(function: Function) -> Function:
    """For what reads its arrays (none of its arguments by name) number by number, over one of the other decorators.

    Where nothing is compiled it is handed their memory, which Python reads in half the time that numpy takes.
    """
    if not PLAIN:
        return function
    return cast("Function", lambda *given: function(*(x.data if isinstance(x, np.ndarray) else x for x in given)))


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
