"""How much work a randomised test does: little in ``make test``, a lot in ``make nightly``."""

from __future__ import annotations

import os

NIGHTLY = os.environ.get("FES_EXAMPLES") == "nightly"


def examples(usual: int, nightly: int) -> int:
    """The number that applies now."""
    return nightly if NIGHTLY else usual
