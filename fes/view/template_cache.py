"""Compiled templates kept from run to run: compiling the report's anew takes a tenth of a second each time."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from jinja2 import FileSystemBytecodeCache
from jinja2.bccache import Bucket


class TemplateCache(FileSystemBytecodeCache):
    """In the user's cache folder; a template that has changed is compiled anew. Where nothing can be kept, none is."""

    def __init__(self) -> None:
        folder = Path(os.devnull)  # where nothing can be
        with suppress(OSError, RuntimeError):  # RuntimeError: a user without a home
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            folder = base / "fes-gait" / "templates"
            folder.mkdir(parents=True, exist_ok=True)
        super().__init__(str(folder))

    def load_bytecode(self, bucket: Bucket) -> None:
        """Fill in a template if it has been kept."""
        with suppress(OSError):
            super().load_bytecode(bucket)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep one compiled template."""
        with suppress(OSError):
            super().dump_bytecode(bucket)
