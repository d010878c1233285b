"""Numbers as options: within a range, and numbers at all; click lets "nan" through every range."""

from __future__ import annotations

import math
from typing import Any

import click


class Number(click.FloatRange):
    """:class:`click.FloatRange` that takes no not-a-number and nothing infinite."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number.

        Raises:
            BadParameter: it is none, or out of range.
        """
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number
