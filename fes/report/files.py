"""A finished page onto the disk: whole or not at all, and never half over an older one.

Dataclasses of numbers → plain JSON values: NaN and infinity become null.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Turn dataclasses, mappings, sequences and numpy values into what ``json.dumps(allow_nan=False)`` takes.

    Anything else becomes its text.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (Sequence, set, frozenset)) and not isinstance(value, (bytes, bytearray)):
        return [plain(item) for item in value]
    return str(value)


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
