"""Where results go: a new folder each time."""

from __future__ import annotations

from pathlib import Path

from fes.cli.exits import Problem

LOG_SUFFIX = ".feslog"


def fresh_folder(out: Path, name: str) -> Path:
    """A new folder ``out/name-NNN``; what is there already is never touched.

    Raises:
        Problem: it cannot be made.
    """
    try:
        if out.exists() and not out.is_dir():
            raise Problem(f"{out}: is a file; results need a folder. Choose another with --out.")
        out.mkdir(parents=True, exist_ok=True)
        for number in range(1, 100_000):
            folder = out / f"{name}-{number:03d}"
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        raise Problem(
            f"{out}: no folder for the results can be made: {error.strerror}. Choose another with --out."
        ) from error
    raise Problem(f"{out}: too many results of {name!r}; move some away or choose another --out.")
