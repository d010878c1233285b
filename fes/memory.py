"""Memory that numpy frees stays with the process: the next array of that size costs no page faults.

The C library gives large arrays back to the system at once and asks for them anew, page by page, zeroed: on a recording
of ten minutes that is a tenth of the analysis. For processes that analyse; nothing else changes.
"""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_LARGEST_BYTES = 32 << 20  # the C library takes no more; larger arrays go back as before
_KEPT_BYTES = 256 << 20


def keep_freed_memory() -> bool:
    """Keep up to a quarter of a gigabyte that is free; False where the C library has no such setting (not glibc)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES) and mallopt(_TRIM_THRESHOLD, _KEPT_BYTES))
