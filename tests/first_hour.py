"""The commands of docs/first_hour.md."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def commands(kind: str) -> list[list[str]]:
    """Those of its blocks of this kind ("sh", "sh live"), word by word, without their comments."""
    text = (ROOT / "docs" / "first_hour.md").read_text(encoding="utf-8")
    blocks = re.findall(rf"^```{kind}\n(.*?)^```", text, re.M | re.S)
    return [words for block in blocks for line in block.splitlines() if (words := shlex.split(line, comments=True))]
