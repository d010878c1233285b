"""Where compiled code is kept: numba's cache, but one whose troubles cost time and nothing else.

Several processes compile at once, and machines with other processors may share the folder. numba numbers the files of a
function's kinds of arguments, so that two that compile it for two kinds take the same number: the list then names one's
code as the other's, which reads its arrays wrongly. Here a file is named after what it is for. A power cut leaves files
that are empty or have holes: what is not whole counts as not there. And where its folder cannot be written to, numba
would keep things beside the sources instead, where they go stale; here nothing is kept.
"""

from __future__ import annotations

import hashlib
import pickle
import zlib
from pathlib import Path
from typing import Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, UserProvidedCacheLocator
from numba.core.runtime.nrt import rtsys

from fes.estimation.compiled import unkept

_CHECK_BYTES = 4


class _Files(IndexDataCacheFile):
    """A list of kinds of arguments, and a file with a checksum for each of them."""

    _kind = ""

    def save(self, key: Any, data: Any) -> None:
        """Keep what was compiled for a key: the types of arguments, and the processor."""
        self._kind = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        super().save(key, data)

    def _data_name(self, number: int) -> str:
        return str(super()._data_name(number)).replace(".nbc", f"-{self._kind}.nbc")

    def _dump(self, obj: Any) -> bytes:
        data = bytes(super()._dump(obj))
        return data + zlib.crc32(data).to_bytes(_CHECK_BYTES)  # what follows a pickle, reading it passes over

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # whatever unpickling makes of what is left of it
            return {}

    def _load_data(self, name: str) -> Any:
        data = Path(self._data_path(name)).read_bytes()
        if zlib.crc32(data[:-_CHECK_BYTES]).to_bytes(_CHECK_BYTES) != data[-_CHECK_BYTES:]:
            raise OSError(f"{name}: is damaged")  # as if it were not there
        return pickle.loads(data)


class _Place(CompileResultCacheImpl):
    """The folder that was named, and no other."""

    _locator_classes: list[type[object]] = [UserProvidedCacheLocator]  # noqa: RUF012


class Cache(FunctionCache):
    """numba's, but one that says once that it cannot be written to instead of ending the session."""

    _impl_class = _Place

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        self._cache_file.__class__ = _Files

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What has been compiled for these types of arguments, None if nothing has."""
        rtsys.initialize(target_context)  # all that finished code needs; numba would load what compiling needs, too
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep it."""
        try:
            # without the source with its types, which is there for reading
            super().save_overload(sig, data._replace(type_annotation=""))
        except OSError as error:
            unkept(error)
