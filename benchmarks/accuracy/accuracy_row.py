"""One line of the accuracy table, and how it is made from errors: the same way for us and for every peer."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

OURS = "fes"
CAUSAL, OFFLINE = "causal", "off-line"


@dataclass(frozen=True)
class Row:
    """One method on one quantity of one data set; all numbers in ``unit``, NaN where there is none.

    ``bias`` is the mean error, ``sd`` the spread about it, ``worst`` the greatest absolute error, ``recall`` the share
    (0–1) of what the reference holds that the method found. ``causal`` numbers are known at the latest when the stride
    (for an event: the event) is over. ``note`` says why a method has no numbers, or what the numbers do not show.
    """

    data_set: str
    quantity: str
    unit: str
    method: str
    known: str
    n: int = 0
    bias: float = float("nan")
    sd: float = float("nan")
    rmse: float = float("nan")
    worst: float = float("nan")
    recall: float = float("nan")
    bar: str = ""
    bar_met: bool | None = None
    note: str = ""

    @property
    def ours(self) -> bool:
        """Whether the method is of this project."""
        return self.method.startswith(OURS)

    def to_json(self) -> dict[str, Any]:
        """Plain values, None instead of NaN."""
        return {key: None if isinstance(v, float) and v != v else v for key, v in asdict(self).items()}


def row_of(
    data_set: str,
    quantity: str,
    unit: str,
    method: str,
    known: str,
    errors: npt.ArrayLike,
    recall: float = float("nan"),
) -> Row:
    """The row of errors (estimate − truth) in ``unit``; those that are not finite do not count."""
    e = np.asarray(errors, dtype=float).ravel()
    e = e[np.isfinite(e)]
    if len(e) == 0:
        return Row(data_set, quantity, unit, method, known, recall=recall, note="nothing found")
    return Row(
        data_set,
        quantity,
        unit,
        method,
        known,
        n=len(e),
        bias=float(e.mean()),
        sd=float(e.std(ddof=1)) if len(e) > 1 else float("nan"),
        rmse=float(np.sqrt((e**2).mean())),
        worst=float(np.abs(e).max()),
        recall=recall,
    )
