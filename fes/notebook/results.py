"""What the functions of ``import fes`` give back: tables, objects, and a report to write.

``result.plot``: figures of an analysis by matplotlib, each on axes that are given or made, and given back.

matplotlib is an extra (``pip install fes-gait[plot]``) and imported when the first figure is drawn.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fes.analysis.parameters.gait import ChunkedGait, GaitParameters, gait_parameters
from fes.analysis.results import LIVE_PHASE_COLUMNS, Analysis, phase_row
from fes.analysis.tables import Table, join_tables, table_of
from fes.estimation.strides import schema
from fes.recording import Recording
from fes.session_log import SessionRecord
from fes.walk_record import Finding

if TYPE_CHECKING:
    from fes.evaluation.reference.evaluation import Evaluation
    from fes.simulation.truth import Truth

COLOURS = {"left": "#0072b2", "right": "#d55e00"}  # Okabe and Ito 2008: told apart by everybody
PHASES = ("stance", "pre_swing", "swing", "loading_response")


class Plots:
    """Figures of one result. Each takes matplotlib ``axes``, or makes them, and returns them.

    Raises:
        ImportError: matplotlib is not installed.
    """

    def __init__(self, result: Result) -> None:
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


File = str | os.PathLike[str]


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What an analysis found. Iteration gives it for each part: one of up to half an hour, else of 15 minutes at most.

    Attributes:
        strides: a row a stride; ``t_swing_s`` and its like are found off-line, with the whole recording, and
            ``t_swing_live_s`` … are when the machine of a live session would have said so.
        events: a row a swing: foot off and initial contact, both ways.
        phases: a row a change of phase, ``t_s`` and ``t_live_s``.
        path: a row a tenth of a second and foot: its place over the ground.
        events_causal: a row an event that an event rule of your own decided, with its delay; None without a rule.
        parameters: gait parameters; ``.table`` has a row a valid stride, ``.summary`` means, sides and the walk's own.
    """

    strides: Table
    events: Table
    phases: Table
    path: Table
    parameters: GaitParameters
    _analyses: Callable[[], Iterator[Analysis]]
    events_causal: Table | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is to be known before the numbers are used, as terminal, JSON and report have it, part by part."""
        from fes.report.findings import findings
        from fes.report.summary import summarise

        return tuple(each for part in self._analyses() for each in findings(summarise(part.walk_record())))

    @property
    def plot(self) -> Plots:
        """Figures by matplotlib: ``strides``, ``phases``, ``path``, ``butterfly``; each returns its axes."""
        return Plots(self)

    def __iter__(self) -> Iterator[Result]:
        for analysis in self._analyses():
            yield gather([analysis])

    def report(self, path: File) -> list[Path]:
        """Write the report as HTML, of several parts one each (``walk-01.html`` …); the paths that were written.

        Raises:
            ReportError: it cannot be written.
        """
        from fes.report.page import write_report

        written, created = [], datetime.now(UTC).isoformat(timespec="seconds")
        for number, analysis in enumerate(self._analyses(), 1):
            whole = analysis.chunk is None or analysis.chunk.whole
            written.append(Path(path) if whole else Path(path).with_stem(f"{Path(path).stem}-{number:02d}"))
            gait = gait_parameters(analysis)
            write_report(analysis.walk_record(created), written[-1], paths=analysis.paths, gait=gait)
        return written

    def analysis(self) -> Analysis:
        """The analysis itself, with samples and trajectories; ValueError where there are several parts."""
        first, *more = self._analyses()
        if more:
            raise ValueError("the recording is too long for this at once: take its parts, `for part in result`")
        return first

    def __repr__(self) -> str:
        return f"Result: {len(self.strides)} strides, {int(self.strides['valid'].sum())} of them valid"


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """A session log: its strides, phases and the gate's commands as tables, and all that it holds as ``record``."""

    record: SessionRecord
    source: str
    strides: Table
    phases: Table
    commands: Table

    def report(self, path: File) -> Path:
        """Write the session's report as HTML; ReportError where it cannot be written."""
        from fes.report.page import write_report

        write_report(self.record, Path(path))
        return Path(path)

    def __repr__(self) -> str:
        counts = f"{len(self.strides)} strides, {len(self.phases)} phase changes, {len(self.commands)} commands"
        return f"Log {self.source}: {counts}"


@dataclass(frozen=True, eq=False, repr=False)
class Simulated:
    """A virtual patient's walk: what its sensors recorded, the truth, its strides (with drag, stumble and charge), and
    the session's log where it was stimulated."""

    recording: Recording
    truth: Truth
    strides: Table
    log: Log | None

    def __repr__(self) -> str:
        return f"Simulated: {self.recording!r}; {len(self.strides)} strides; {self.log or 'no stimulation'}"


@dataclass(frozen=True, eq=False, repr=False)
class Agreement:
    """Estimate minus reference, SI: ``table`` by quantity and foot (bias, 95 % limits of agreement, ICC(2,1)), its
    ``pairs``; ``evaluation`` has all of it as objects, its notes and warnings too."""

    table: Table
    pairs: Table
    evaluation: Evaluation

    def report(self, path: File) -> Path:
        """Write the page of the agreement as HTML; ReportError where it cannot be written."""
        from fes.report.agreement import render_page
        from fes.report.html import write_page_file

        write_page_file(render_page(self.evaluation), Path(path), "Choose another path.")
        return Path(path)

    def __repr__(self) -> str:
        return f"Agreement: {len(self.pairs)} pairs; .table has bias, limits of agreement and ICC"


def gather(analyses: list[Analysis] | Callable[[], Iterator[Analysis]]) -> Result:
    """Gather the tables part by part; of a long recording only they are kept.

    Args:
        analyses: of each part; of a long recording what begins the analysis anew.
    """
    anew: Callable[[], Iterator[Analysis]] = analyses if callable(analyses) else lambda: iter(analyses)
    tables, gaits = list[dict[str, Table]](), list[GaitParameters]()
    sums: ChunkedGait | None = None
    for analysis in anew():
        gaits.append(gait_parameters(analysis))
        if callable(analyses):
            sums = sums or ChunkedGait(analysis.recording.belt_speed_mps)
            sums.add(gaits[-1], analysis.strides)
        tables.append(analysis.tables())
    gait = gaits[0]
    if sums is not None and len(gaits) > 1:
        feet = dict.fromkeys(foot for each in gaits for foot in each.strides)
        own = {foot: [each.strides[foot] for each in gaits if foot in each.strides] for foot in feet}
        gait = replace(sums.parameters(), strides={foot: join_tables(tables) for foot, tables in own.items()})
    joined = {name: join_tables([each[name] for each in tables]) for name in tables[0]}
    return Result(**joined, parameters=gait, _analyses=anew)


def log_of(record: SessionRecord, source: str) -> Log:
    """A session log's tables; ``source`` names it in an agreement."""
    strides = Table.from_rows(schema.LIVE_TABLE, [schema.table_row(stride) for stride in record.strides])
    phases = Table.from_rows(LIVE_PHASE_COLUMNS, [phase_row(change) for change in record.phases])
    return Log(record, source, strides, phases, table_of([asdict(command) for command in record.commands]))
