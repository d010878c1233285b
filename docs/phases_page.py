"""Write what docs/phases.md takes from the code, and its two pictures: ``python docs/phases_page.py [--check]``.

The theory is the docstring of ``statemachine``, the transitions are the table's, their words the first lines of the
guards' docstrings, what each looks at is what it does look at, and the thresholds are the fields of ``Thresholds`` with
the docstrings beneath them. ``phases.svg`` shows the phases and transitions, ``phases_stride.svg`` one stride of a
bundled trial, run through the tracker. So the page cannot say something else than what runs; a test holds it.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import math
import re
import sys
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path

import numpy as np

import statemachine
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import read_recording
from fes.report.figures.strides import PHASE_COLORS
from fes.report.figures.svg import nice_ticks
from fes.report.text import readable
from fes.signals import NS_PER_S
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE, Row
from statemachine.terms import Term, Terms, feature_words, terms_of, unit

ROOT = Path(__file__).resolve().parents[1]
PAGE, STATES, STRIDE = (ROOT / "docs" / name for name in ("phases.md", "phases.svg", "phases_stride.svg"))
TRIAL, FOOT = ROOT / "sim_inputs" / "negard_patient1.parquet", "right_foot"
STRIDES_BEFORE = 12  # of the one that is shown, so that the measures have followed
BEGIN, END = "<!-- begin: written by `python docs/phases_page.py` -->", "<!-- end -->"
PICTURE = re.compile(r"(?:^    .*\n)+", re.MULTILINE)  # the docstring's own, of letters
INK, GREY, WIDTH = "#1b1f24", "#6b7280", 900
NOTHING = Features._make([0.0] * len(Features._fields))


def name_of(phase: Phase) -> str:
    """``PRE_SWING`` → ``pre-swing``."""
    return readable(phase.name.lower())


def condition(row: Row) -> str:
    """What lets the transition happen, in words: its guard's docstring's first line behind the colon."""
    first = inspect.cleandoc(row.guard.__doc__ or "").splitlines()[0]
    return first.partition(": ")[2].rstrip(".")


def looks_at(row: Row) -> list[str]:
    """What the guard compares with limits, each once."""
    seen = (term.what.lstrip("−").replace("|", "") for term in terms_of(row.guard, NOTHING, Thresholds()).each())
    return list(dict.fromkeys(seen))


# --- the page --------------------------------------------------------------------------------------------


def transitions_table() -> str:
    """The table as Markdown."""
    lines = ["| | from | to | when | looks at |", "|---|---|---|---|---|"]
    lines += [
        f"| {row.transition.name} | {name_of(row.source)} | {name_of(row.destination)} | {condition(row)} "
        f"| {', '.join(looks_at(row))} |"
        for row in TABLE
    ]
    return "\n".join(lines)


def described() -> dict[str, str]:
    """Of each threshold the docstring beneath it."""
    (tree,) = ast.parse(inspect.getsource(Thresholds)).body
    assert isinstance(tree, ast.ClassDef)
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in zip(tree.body, tree.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


def thresholds_table() -> str:
    """All thresholds with value, unit, which transitions look at them, meaning and origin, as Markdown."""
    lines = ["| threshold | default | unit | for | what it is | where it comes from |", "|---|---|---|---|---|---|"]
    for name, text in described().items():
        value = Thresholds._field_defaults[name]
        shown = ("no", "yes")[value] if isinstance(value, bool) else f"{value:g}"
        used, _, rest = text.partition(": ")
        meaning, _, origin = rest.partition(" Origin: ")
        lines.append(f"| `{name}` | {shown} | {unit(name)} | {used} | {meaning} | {origin[:1].upper()}{origin[1:]} |")
    return "\n".join(lines)


def generated(stride: Shown) -> str:
    """All that stands between the markers."""
    theory = inspect.cleandoc(statemachine.__doc__ or "").partition("\n\n")[2]
    theory, _, read_on = theory.rpartition("\n\n")
    features = inspect.cleandoc(Features.__doc__ or "").replace("``", "`")
    picture = f"![The four phases and the six transitions]({STATES.name})\n"
    return "\n\n".join(
        (
            PICTURE.sub(picture, theory),
            transitions_table(),
            f"**What they look at.** {features}",
            read_on,
            f"## One stride\n\n{stride.words}\n\n![One stride's signals, phases and limits]({STRIDE.name})",
            stride.table(),
            f"## Thresholds\n\n{inspect.cleandoc(Thresholds.__doc__ or '').replace('``', '`')}",
            thresholds_table(),
        )
    )


def updated(text: str, new: str, begins: str = BEGIN) -> str:
    """A document with what stands between the markers made anew.

    Raises:
        ValueError: the markers are not there in order, or the first stands there twice.
    """
    before, begin, rest = text.partition(begins)
    _, end, after = rest.partition(END)
    if not begin or not end or begins in after:
        raise ValueError(f"expected one line {begins!r} and after it a line {END!r}")
    return f"{before}{begins}\n\n{new}\n\n{END}{after}"


# --- the phases and transitions --------------------------------------------------------------------------

BOX = 200, 110
PLACES = {  # centre of each phase, and how its foot lies: turned toe-up by degrees, lifted by points
    Phase.STANCE: (150, 105, 0, 0),
    Phase.PRE_SWING: (750, 105, -30, 0),
    Phase.SWING: (750, 355, 4, 16),
    Phase.LOADING_RESPONSE: (150, 355, 22, 0),
}
ARROWS = {  # from, to; where the words begin, how they are anchored, and how many letters fit in a line
    Transition.T1: (250, 82, 650, 82, 450, 40, "middle", 52),
    Transition.T2: (750, 160, 750, 300, 760, 196, "start", 20),
    Transition.T3: (650, 378, 250, 378, 450, 400, "middle", 52),
    Transition.T4: (150, 300, 150, 160, 160, 214, "start", 30),
    Transition.T5: (650, 128, 250, 128, 450, 146, "middle", 52),
    Transition.T6: (650, 332, 250, 150, 470, 212, "start", 26),
}
FOOT_SHAPE = (  # heel at 0, toe at 74, y upward
    (0, 0), (74, 0), (75, 6), (62, 14), (38, 24), (30, 44), (8, 44), (6, 22), (-3, 10),
)  # fmt: skip


def lines_of(x: float, y: float, text: str, letters: int, **attributes: str) -> Iterator[str]:
    """Text in lines of so many letters at most."""
    said = " ".join(f'{name.replace("_", "-")}="{value}"' for name, value in attributes.items())
    for k, line in enumerate(textwrap.wrap(text, letters)):
        yield f'<text x="{x}" y="{y + 16 * k}" {said}>{escape(line)}</text>'


def foot_shape(x: float, ground: float, turned_deg: float, lifted: float) -> str:
    """A foot on the ground, turned toe-up about its heel, toe-down about its toe."""
    pivot, (c, s) = (0 if turned_deg > 0 else 70), (f(math.radians(turned_deg)) for f in (math.cos, math.sin))
    points = [(pivot + (a - pivot) * c - b * s, (a - pivot) * s + b * c) for a, b in FOOT_SHAPE]
    path = " ".join(f"{x + a:.1f},{ground - lifted - b:.1f}" for a, b in points)
    return (
        f'<path d="M{x - 40} {ground}h150" stroke="{GREY}" stroke-width="1.5"/>'
        f'<polygon points="{path}" fill="#fff" stroke="{INK}" stroke-width="1.6" stroke-linejoin="round"/>'
    )


def svg(height: float, marks: Sequence[str]) -> str:
    """A picture by itself."""
    return "\n".join(
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" font-family="sans-serif" '
            f'font-size="13" fill="{INK}">',
            '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" '
            f'orient="auto"><path d="M0 0L10 5L0 10Z" fill="{INK}"/></marker></defs>',
            f'<rect width="{WIDTH}" height="{height:g}" fill="#fff"/>',
            *marks,
            "</svg>\n",
        )
    )


def states_picture() -> str:
    """The phases and the table's transitions."""
    marks = []
    for phase, (x, y, turned, lifted) in PLACES.items():
        color = PHASE_COLORS[phase.name.lower()]
        left, top = x - BOX[0] / 2, y - BOX[1] / 2
        marks.append(
            f'<rect x="{left:g}" y="{top:g}" width="{BOX[0]}" height="{BOX[1]}" rx="12" fill="{color}" '
            f'fill-opacity="0.45" stroke="{INK}"/>'
        )
        marks.append(f'<text x="{x}" y="{top + 21:g}" text-anchor="middle" font-weight="bold">{name_of(phase)}</text>')
        marks.append(foot_shape(x - 35, top + 98, turned, lifted))
    for row in TABLE:
        x1, y1, x2, y2, x, y, anchor, letters = ARROWS[row.transition]
        usual = "" if row.transition <= Transition.T4 else ' stroke-dasharray="6 4"'
        marks.append(
            f'<path d="M{x1} {y1}L{x2} {y2}" stroke="{INK}" stroke-width="1.6"{usual} marker-end="url(#tip)"/>'
        )
        marks += lines_of(x, y, f"{row.transition.name} {condition(row)}", letters, text_anchor=anchor)
    return svg(460, marks)


# --- one stride ------------------------------------------------------------------------------------------

COLORS = {"T1": "#B45309", "T2": "#1D4ED8", "T3": "#A21CAF", "T4": "#047857", "T5": "#6b7280", "T6": "#6b7280"}
Panel = tuple[str, str, tuple[str, ...], float]
PANELS: tuple[Panel, ...] = (  # unit, what is drawn of that unit beside the limits of it, and how far at most
    ("rad/s", "turning toe-down, rad/s", ("toe down",), math.inf),
    ("rad", "angle, rad, cut off beyond 0.2", ("turned", "pitch"), 0.2),
    ("m/s³", "jump of the force, m/s³", ("contact jerk",), math.inf),
)
DASHES = ("none", "5 3")
DASHED = 'stroke-dasharray="4 3"'
THRESHOLDS_OF_T = tuple(name for name, text in described().items() if not text.startswith("measure"))
HALO = 'stroke="#fff" stroke-width="3" stroke-linejoin="round" paint-order="stroke"'
LEFT, RIGHT, TOP, TALL, BETWEEN = 64, 128, 44, 190, 26


@dataclass(frozen=True)
class Shown:
    """A stride from flat foot to flat foot: time (s), phase before, and what was seen of each sample.

    ``changes``: at which sample, which transition, and its terms.
    """

    number: int
    t_s: list[float]
    phase: list[Phase]
    seen: list[tuple[Features, Thresholds]]
    changes: list[tuple[int, Transition, Terms]]

    @property
    def words(self) -> str:
        """Below the heading."""
        return (
            f"Stride {self.number} of the {readable(FOOT)} of `sim_inputs/{TRIAL.name}`, from flat foot to flat foot: "
            "what the guards look at, the phases behind it. A dashed line is a limit while its guard is asked, an "
            "upright one the sample at which a guard fires. Times count too; they are not drawn."
        )

    def table(self) -> str:
        """What each guard that fired saw then."""
        lines = ["| at | guard | what held |", "|---|---|---|"]
        for k, transition, terms in self.changes:
            held = "; ".join(str(term).replace("|", r"\|") for term in held_by(terms))
            lines.append(f"| {self.t_s[k]:.2f} s | {transition.name} | {held} |")
        return "\n".join(lines)


def held_by(terms: Terms | Term) -> Iterator[Term]:
    """The comparisons that made a guard fire, without those of clauses that did not hold."""
    if isinstance(terms, Term):
        yield terms
        return
    for part in terms.parts:
        if part.holds:
            yield from held_by(part)


def stride_shown() -> Shown:
    """Run the trial until the stride after ``STRIDES_BEFORE`` is over."""
    track = read_recording(TRIAL).tracks[FOOT]
    calibration = calibrate_track(track)
    settings = StrideSettings(calibration.forward(), np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker(FOOT, settings))
    row_of = {row.transition: row for row in TABLE}
    number, begin_ns = 0, 0
    shown = Shown(STRIDES_BEFORE + 1, [], [], [], [])
    samples = zip(track.t_sensor_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist(), strict=True)
    for t_ns, acc, gyr in samples:
        before = tracker.phase
        gone = [one for one in tracker.step(t_ns, tuple(acc), tuple(gyr)) if isinstance(one, PhaseChange)]
        if begin_ns:
            shown.t_s.append((t_ns - begin_ns) / NS_PER_S)
            shown.phase.append(before)
            shown.seen.append(tracker.seen())
            for change in gone:
                terms = terms_of(row_of[change.transition].guard, *tracker.seen())
                shown.changes.append((len(shown.t_s) - 1, change.transition, terms))
        if any(change.transition is Transition.T4 for change in gone):
            if begin_ns:
                return shown
            number += 1
            begin_ns = t_ns if number == STRIDES_BEFORE else 0
    raise ValueError(f"{TRIAL.name} has no {STRIDES_BEFORE + 1} strides")


def limits(stride: Shown, of: str, names: Sequence[str]) -> Iterator[tuple[str, str, int, list[float]]]:
    """The limits of these while their guards are asked: guard, words, from which sample on, values.

    Of a limit on the size, which has two lines, the upper one says so and the lower one has no words. A comparison with
    a plain number is left out: it belongs to a threshold that is no limit.
    """
    for row in TABLE[:4]:
        asked = [k for k, phase in enumerate(stride.phase) if phase is row.source]
        terms = [list(terms_of(row.guard, *stride.seen[k]).each()) for k in asked]
        for each in zip(*terms, strict=True):
            what = each[0].what
            if each[0].unit != of or what.lstrip("−").replace("|", "").split(" + ")[0] not in names:
                continue
            threshold = next((name for name in THRESHOLDS_OF_T if name in each[0].limit_is), "")
            if not threshold:
                continue
            words = f"{row.transition.name} {threshold}"
            if "|" in what:
                yield (
                    row.transition.name,
                    f"{row.transition.name} ±{threshold}",
                    asked[0],
                    [term.limit for term in each],
                )
                words = ""
            sign = -1.0 if what.startswith(("−", "|")) else 1.0
            yield row.transition.name, words, asked[0], [sign * term.limit for term in each]


def panel(stride: Shown, panel_of: Panel, top: float, across: Callable[[float], float]) -> Iterator[str]:
    """One unit's signals and limits in a frame."""
    of, label, names, reach = panel_of
    fields = {name: next(f for f in Features._fields if name == feature_words(f)) for name in names}
    signals = {name: [getattr(x, field) for x, _ in stride.seen] for name, field in fields.items()}
    lines = list(limits(stride, of, names))
    every = [value for values in (*signals.values(), *(line[3] for line in lines)) for value in values]
    low, high = max(min(every), -reach), min(max(every), reach)
    low, high = low - 0.04 * (high - low), high + 0.12 * (high - low)

    def up(value: float) -> float:
        return top + TALL * (high - value) / (high - low)

    def path(begin: int, values: Sequence[float]) -> str:
        points = [(f"{across(t_s):.1f}", f"{up(y):.1f}") for t_s, y in zip(stride.t_s[begin:], values, strict=False)]
        inner = (b for a, b, c in zip(points, points[1:], points[2:], strict=False) if not a[1] == b[1] == c[1])
        return "M" + "L".join(" ".join(point) for point in (points[0], *inner, points[-1]))

    frame = f'x="{LEFT}" y="{top}" width="{WIDTH - LEFT - RIGHT}" height="{TALL}"'
    yield f'<clipPath id="frame{top}"><rect {frame}/></clipPath>'

    for value in nice_ticks(low, high, 5):
        yield f'<path d="M{LEFT} {up(value):.1f}H{WIDTH - RIGHT}" stroke="#fff" stroke-width="1"/>'
        yield f'<text x="{LEFT - 7}" y="{up(value) + 4:.1f}" text-anchor="end" font-size="11">{value:g}</text>'
    for values, dash in zip(signals.values(), DASHES, strict=False):
        yield (
            f'<path d="{path(0, values)}" fill="none" stroke="{INK}" stroke-width="1.6" stroke-dasharray="{dash}" '
            f'clip-path="url(#frame{top})"/>'
        )
    words: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for guard, said, begin, values in lines:
        yield f'<path d="{path(begin, values)}" fill="none" stroke="{COLORS[guard]}" stroke-width="1.4" {DASHED}/>'
        if said:
            words[guard].append((up(values[-1] if guard == "T4" else values[0]), said))
    for guard, each in words.items():
        (begin,) = {begin for name, _, begin, _ in lines if name == guard}
        x = WIDTH - RIGHT + 5 if guard == "T4" else across(stride.t_s[begin]) + 4  # T4's stand in the margin
        lowest = top
        for y, said in sorted(each):
            lowest = max(lowest + 12, y + 4 if guard == "T4" else y - 4)
            yield f'<text x="{x:.1f}" y="{lowest:.1f}" font-size="11" fill="{COLORS[guard]}" {HALO}>{said}</text>'
    drawn = ", ".join(f"{name} {shown}" for name, shown in zip(names, ("drawn through", "dashed"), strict=False))
    said = label if len(names) == 1 else f"{label}: {drawn}"
    yield f'<text x="{LEFT + 6}" y="{top + 15}" font-weight="bold" {HALO}>{said}</text>'
    yield f'<rect {frame} fill="none" stroke="{GREY}"/>'


def stride_picture(stride: Shown) -> str:
    """The stride's signals one above the other, phases behind them, limits and instants marked."""
    end_s = stride.t_s[-1]
    height = TOP + len(PANELS) * (TALL + BETWEEN) + 20
    marks = []

    def across(t_s: float) -> float:
        return LEFT + t_s / end_s * (WIDTH - LEFT - RIGHT)

    starts = [0, *(k for k, _, _ in stride.changes)]
    for k, last in pairwise(starts):
        phase, x1, x2 = stride.phase[last], across(stride.t_s[k]), across(stride.t_s[last])
        marks.append(
            f'<rect x="{x1:.1f}" y="{TOP}" width="{x2 - x1:.1f}" height="{height - TOP - 46}" '
            f'fill="{PHASE_COLORS[phase.name.lower()]}" fill-opacity="0.3"/>'
        )
        marks.append(f'<text x="{(x1 + x2) / 2:.1f}" y="16" text-anchor="middle">{name_of(phase)}</text>')
    for k, transition, _ in stride.changes:
        x = across(stride.t_s[k])
        marks.append(f'<path d="M{x:.1f} 38V{height - 46}" stroke="{COLORS[transition.name]}" stroke-width="1.4"/>')
        marks.append(
            f'<text x="{x:.1f}" y="34" text-anchor="middle" font-weight="bold" fill="{COLORS[transition.name]}">'
            f"{transition.name}</text>"
        )
    for number, each in enumerate(PANELS):
        marks += panel(stride, each, TOP + number * (TALL + BETWEEN), across)
    for t_s in nice_ticks(0.0, end_s, 8):
        marks.append(f'<text x="{across(t_s):.1f}" y="{height - 30}" text-anchor="middle">{t_s:g}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    marks.append(f'<text x="{middle:g}" y="{height - 10}" text-anchor="middle">time since the foot was flat, s</text>')
    return svg(height, marks)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page and its pictures, or check that they are as they would be written."""
    parser = argparse.ArgumentParser(prog="python docs/phases_page.py", description=main.__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if something is out of date")
    check = parser.parse_args(arguments).check
    stride = stride_shown()
    new = {
        PAGE: updated(PAGE.read_text(encoding="utf-8"), generated(stride)),
        STATES: states_picture(),
        STRIDE: stride_picture(stride),
    }
    old = [path for path, text in new.items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    for path in old:
        if check:
            print(f"{path.name} is out of date: run python docs/phases_page.py")
        else:
            path.write_text(new[path], encoding="utf-8")
    return int(check and bool(old))


if __name__ == "__main__":
    sys.exit(main())
