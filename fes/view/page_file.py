"""A finished page onto the disk: whole or not at all, and never half over an older one."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


class ReportError(OSError):
    """A report cannot be written; the message names the file and what to do, ``strerror`` why."""


def write_page_file(text: str, path: Path, remedy: str) -> None:
    """Write a page, replacing an older one.

    Args:
        text: the page.
        path: where to; folders are made.
        remedy: what the person can do if it cannot be written, as a sentence.

    Raises:
        ReportError: it cannot be written.
    """
    draft = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        why = error.strerror or str(error)
        failure = ReportError(f"{path}: cannot be written: {why}. {remedy}")
        failure.strerror = why
        raise failure from error
