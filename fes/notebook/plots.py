"""``result.plot``: figures of an analysis by matplotlib, each on axes that are given or made, and given back.

matplotlib is an extra (``pip install fes-gait[plot]``) and imported when the first figure is drawn.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from fes.analysis.results import Analysis
    from fes.analysis.tables import Table

COLOURS = {"left": "#0072b2", "right": "#d55e00"}  # Okabe and Ito 2008: told apart by everybody
PHASES = ("stance", "pre_swing", "swing", "loading_response")


class Shown(Protocol):
    """What is drawn of a result."""

    @property
    def strides(self) -> Table:
        """A row a stride."""

    @property
    def phases(self) -> Table:
        """A row a change of phase."""

    @property
    def path(self) -> Table:
        """A row a tenth of a second and foot."""

    def analysis(self) -> Analysis:
        """The whole, of one part."""


class Plots:
    """Figures of one result. Each takes matplotlib ``axes``, or makes them, and returns them.

    Raises:
        ImportError: matplotlib is not installed.
    """

    def __init__(self, result: Shown) -> None:
        self._result = result

    def strides(self, column: str = "stride_length_m", axes: Any = None) -> Any:
        """A column of the valid strides over time, by foot.

        Raises:
            KeyError: the strides have no such column.
        """
        axes, table = _axes(axes), self._result.strides
        valid = table["valid"]
        for foot in _feet(table["foot"]):
            own = valid & (table["foot"] == foot)
            axes.plot(table["t_end_s"][own], table[column][own], ".-", color=_colour(foot), label=_shown(foot))
        unit = next(one.unit for one in table.columns if one.name == column)
        name = column.removesuffix("_m").removesuffix("_s").removesuffix("_mps").removesuffix("_rad").replace("_", " ")
        axes.set(xlabel="time, s", ylabel=f"{name}, {unit}" if unit else name)
        return _with_legend(axes)

    def phases(self, begin_s: float | None = None, seconds: float = 10.0, axes: Any = None) -> Any:
        """Phases of each foot as bars, from ``begin_s`` (the first change) for some seconds; off-line where known."""
        axes, table = _axes(axes), self._result.phases
        begin = float(table["t_live_s"].min()) if begin_s is None and len(table) else float(begin_s or 0.0)
        shades = dict(zip(PHASES, (0.15, 0.45, 0.95, 0.7), strict=True))
        feet = _feet(table["foot"])
        for row, foot in enumerate(feet):
            own = table["foot"] == foot
            t, names = np.where(np.isnan(t_s := table["t_s"][own]), table["t_live_s"][own], t_s), table["to"][own]
            for start, end, name in zip(t[:-1], t[1:], names[:-1], strict=True):
                if end > begin and start < begin + seconds and name in shades:
                    place = (start, min(end, begin + seconds) - start)
                    axes.broken_barh([place], (row - 0.4, 0.8), color=_colour(foot), alpha=shades[name])
        axes.set(xlabel="time, s", yticks=range(len(feet)), yticklabels=[_shown(foot) for foot in feet])
        axes.set(xlim=(begin, begin + seconds), title="darker: pre-swing, loading response, swing")
        return axes

    def path(self, axes: Any = None) -> Any:
        """The feet's paths over the ground from above, x ahead."""
        axes, table = _axes(axes), self._result.path
        for foot in _feet(table["foot"]):
            own = table["foot"] == foot
            axes.plot(table["x_m"][own], table["y_m"][own], color=_colour(foot), label=_shown(foot))
        axes.set(xlabel="ahead, m", ylabel="left, m", aspect="equal")
        return _with_legend(axes)

    def butterfly(self, axes: Any = None) -> Any:
        """Each valid stride's path in its own frame, height over distance, the right foot's mirrored: two wings.

        Raises:
            ValueError: the result has several parts; take them one by one.
        """
        axes = _axes(axes)
        labelled = set()
        for stride in self._result.analysis().strides:
            if stride.valid and len(stride.trajectory_m):
                along, height = stride.trajectory_m[:, 0], stride.trajectory_m[:, 2]
                sign = -1.0 if stride.foot.startswith("right") else 1.0
                label = None if stride.foot in labelled else _shown(stride.foot)
                labelled.add(stride.foot)
                axes.plot(sign * along, 100.0 * height, color=_colour(stride.foot), alpha=0.3, lw=0.8, label=label)
        axes.axvline(0.0, color="0.6", lw=0.8)
        axes.set(xlabel="right foot  ←  distance, m  →  left foot", ylabel="height, cm")
        return _with_legend(axes)


def _axes(axes: Any) -> Any:
    if axes is not None:
        return axes
    try:
        pyplot = import_module("matplotlib.pyplot")
    except ImportError as error:
        raise ImportError("Figures take matplotlib: pip install fes-gait[plot]") from error
    return pyplot.subplots(layout="constrained")[1]


def _with_legend(axes: Any) -> Any:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False)
    return axes


def _feet(names: np.ndarray[Any, Any]) -> list[str]:
    return sorted({str(name) for name in names})


def _colour(foot: str) -> str:
    return COLOURS.get(foot.split("_")[0], "#444444")


def _shown(foot: str) -> str:
    return foot.removesuffix("_foot").replace("_", " ")
