"""``jit``: numba's compiler with a cache that cannot go stale.

numba decides by a file's own time stamp whether its cached machine code is still good, and does not see a change in a
function that the file calls. A guard edited in ``statemachine/guards.py`` would go on running in its old form. So the
cache lives in a folder named by a digest of all the sources that get compiled together.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba

import fes.signals

Function = TypeVar("Function", bound=Callable[..., Any])

_told: list[Exception] = []


def unkept(error: Exception) -> None:
    """Say once that compiled code cannot be kept."""
    if not _told:
        _told.append(error)
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


def _cache_folder() -> Path:
    digest = hashlib.sha256()
    for source in _sources():
        digest.update(source.read_bytes())
    name = digest.hexdigest()[:16]
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fes-gait" / name
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):  # a read-only home, or none: compile once per boot instead of once per version
        try:
            own = Path(tempfile.gettempdir()) / f"fes-gait-{os.getuid()}"
            own.mkdir(exist_ok=True, mode=0o700)
            if own.stat().st_uid != os.getuid():  # anybody can make it, and what is in it would be run
                raise PermissionError(f"{own} belongs to somebody else")
            folder = own / name
            folder.mkdir(exist_ok=True)
        except OSError as error:  # nor anything else: compile at every start
            unkept(error)
            folder = Path(os.devnull) / name  # where nothing can be
    return folder


CACHE: Final = _cache_folder()
setattr(numba.config, "CACHE_DIR", str(CACHE))  # noqa: B010 - numba fills its config at run time


def _compiled(function: Function, **options: str | set[str]) -> Function:
    plain: Any = numba.njit
    return cast(Function, plain(cache=CACHE.is_dir(), nogil=True, **options)(function))


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
