"""Which program worked on something: its version and a digest of its sources, so that no old result passes for new."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from fes import __version__

PACKAGES: Final = ("fes", "drivers", "statemachine")


@cache
def program() -> str:
    """The version, and eight digits that change with any line of this program."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        found = find_spec(package)
        for folder in (found.submodule_search_locations if found else None) or ():
            for source in sorted(Path(folder).rglob("*.py")):
                digest.update(source.relative_to(folder).as_posix().encode() + b"\0")
                digest.update(source.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:8]}"
