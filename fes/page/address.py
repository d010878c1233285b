"""The page's address, and the file that holds the newest link."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

LOOPBACK: Final = "127.0.0.1"


def link_address(port: int, token: str) -> str:
    """The address to open; what stands behind # never leaves the browser by itself."""
    return f"http://{LOOPBACK}:{port}/#{token}"


def write_link(path: Path, address: str) -> None:
    """Put the address into its file, for the owner only; who reads meanwhile gets the old one or the new one.

    Raises:
        OSError: it cannot be written.
    """
    new = path.with_suffix(".new")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(address + "\n")
    new.replace(path)
