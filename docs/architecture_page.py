"""Write the table of rooms in docs/architecture.md, and two pictures: ``python docs/architecture_page.py [--check]``.

A room's words are its own docstring's, its floor is that of tests/test_import_rules.py, and the frames of
``can_frames.svg`` are the DBC's, bit by bit. So the pages cannot say something else than the code; a test holds it.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path

import cantools
from phases_page import GREY, INK, lines_of, svg, updated

ROOT = Path(__file__).resolve().parents[1]
DBC = ROOT / "drivers" / "stimulator" / "fes_stimulator.dbc"
PAGE, LOOP, FRAMES = (ROOT / "docs" / name for name in ("architecture.md", "loop.svg", "can_frames.svg"))
TREES = ("fes", "drivers", "statemachine")
BEGIN = "<!-- begin: written by `python docs/architecture_page.py` -->"

BOX_WIDTH, BOX_HEIGHT = 128, 80
BOXES = {  # name: what it does; left edge and top
    "sensor": ("how the foot turns and accelerates", 16, 60),
    "estimator": ("how the foot lies, the path of each stride", 188, 60),
    "phase machine": ("four phases, six guarded transitions", 360, 60),
    "plan": ("phases to bursts, strides to tuning", 532, 60),
    "safety gate": ("checks every command by itself, or off", 744, 60),
    "stimulator": ("off by itself when commands stop coming", 744, 204),
    "leg": ("moves, and the next sample shows it", 16, 204),
    "session log": ("everything, so that a replay gives the same bytes", 360, 204),
}
PROCESSES = (("the controller's process", 176, 496), ("the supervisor's process", 732, 152))  # left edge, width
ALONG = ("sensor", "estimator", "phase machine", "plan", "safety gate")
BIT, BITS_FROM, FRAME_HEIGHT, FRAME_EVERY = 12, 122, 34, 62
COLORS = {"Crc": "#e5e7eb", "Counter": "#dbeafe", "CounterHigh": "#dbeafe", "Session": "#dbeafe", "Reserved": "#fff"}
ASKED = "#fde68a"  # what is asked for, done or counted


def rooms() -> str:
    """Every room and every file beside the rooms, from the top floor down, with the first line of its docstring."""
    sys.path.insert(0, str(ROOT / "tests"))
    from test_import_rules import FLOORS  # where the floors are held

    faces = {path.parent: path for top in TREES for path in (ROOT / top).rglob("__init__.py")}
    faces |= {path: path for path in (ROOT / "fes").glob("*.py") if path.name != "__init__.py"}
    del faces[ROOT / "fes"]
    rows = []
    for place, path in faces.items():
        module = ".".join(place.relative_to(ROOT).with_suffix("").parts)
        held = [(len(room), k) for k, each in enumerate(FLOORS) for room in each if f"{module}.".startswith(f"{room}.")]
        _, floor = max(held)
        words = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").splitlines()[0]
        name = place.relative_to(ROOT).as_posix() + ("/" if place.is_dir() else "")
        rows.append((-floor, name, f"| {floor} | `{name}` | {words.replace('``', '`')} |"))
    return "\n".join(("| floor | room | what it does |", "|---|---|---|", *(row for *_, row in sorted(rows))))


def arrow(path: str, *, dashed: bool = False) -> str:
    """A line with a tip; dashed where it only tells the log."""
    dashes = f' stroke="{GREY}" stroke-dasharray="4 3"' if dashed else f' stroke="{INK}" marker-end="url(#tip)"'
    return f'<path d="{path}" fill="none" stroke-width="1.6"{dashes}/>'


def loop() -> Iterator[str]:
    """From the foot to the stimulator and back, with what runs in a process of its own."""
    for name, left, width in PROCESSES:
        yield f'<rect x="{left}" y="30" width="{width}" height="126" rx="10" fill="#f3f4f6" stroke="{GREY}"/>'
        yield f'<text x="{left + 10}" y="48" font-size="12" fill="{GREY}">{escape(name)}</text>'
    middle = BOX_HEIGHT / 2
    for name, (does, x, y) in BOXES.items():
        fill = "#fecaca" if name == "safety gate" else "#fff"
        yield f'<rect x="{x}" y="{y}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="8" fill="{fill}" stroke="{INK}"/>'
        yield f'<text x="{x + 64}" y="{y + 18}" text-anchor="middle" font-weight="bold">{name}</text>'
        yield from lines_of(x + 64, y + 37, does, 22, text_anchor="middle", font_size="11")
    for before, after in pairwise(ALONG):
        (_, x, y), (_, to, _) = BOXES[before], BOXES[after]
        yield arrow(f"M{x + BOX_WIDTH} {y + middle}H{to}")
    (_, gate, top), (_, _, under), (_, leg, _) = BOXES["safety gate"], BOXES["stimulator"], BOXES["leg"]
    yield arrow(f"M{gate + 64} {top + BOX_HEIGHT}V{under}")
    yield arrow(f"M{gate + 64} {under + BOX_HEIGHT}V304H{leg + 64}V{under + BOX_HEIGHT}")
    yield arrow(f"M{leg + 64} {under}V{top + BOX_HEIGHT}")
    (_, log, _) = BOXES["session log"]
    yield arrow(f"M424 {top + BOX_HEIGHT}V{under}", dashed=True)
    yield arrow(f"M{gate} {under + 20}H{log + BOX_WIDTH}", dashed=True)
    yield '<text x="450" y="322" text-anchor="middle" font-size="12">current, and what the muscle does</text>'


def frames() -> Iterator[str]:
    """Each frame of the DBC as a row of 64 bits, the least significant of byte 0 first."""
    for byte in range(8):
        x = BITS_FROM + 8 * BIT * byte
        yield f'<text x="{x + 4 * BIT}" y="18" text-anchor="middle" font-size="11" fill="{GREY}">byte {byte}</text>'
    for row, message in enumerate(sorted(cantools.database.load_file(DBC).messages, key=lambda each: each.frame_id)):
        top = 28 + FRAME_EVERY * row
        yield f'<text x="8" y="{top + 15}" font-weight="bold" font-size="12">{message.name}</text>'
        yield f'<text x="8" y="{top + 31}" font-size="11" fill="{GREY}">0x{message.frame_id:X}</text>'
        for signal in message.signals:
            x, width = BITS_FROM + BIT * signal.start, BIT * signal.length
            fill = COLORS.get(signal.name, ASKED)
            yield (
                f'<rect x="{x}" y="{top}" width="{width}" height="{FRAME_HEIGHT}" fill="{fill}" stroke="{INK}">'
                f"<title>{signal.name}: {signal.length} bits from bit {signal.start}</title></rect>"
            )
            said = signal.name if 6.4 * len(signal.name) < width else ""
            unit = f"{signal.scale:g} {signal.unit}".replace("1 ", "", 1) if signal.unit and width > 30 else ""
            below = "" if said or signal.name == "Reserved" else signal.name
            at = min(x + width / 2, BITS_FROM + 64 * BIT - 22)
            yield f'<text x="{x + width / 2}" y="{top + 15}" text-anchor="middle" font-size="11">{said}</text>'
            yield f'<text x="{x + width / 2}" y="{top + 28}" text-anchor="middle" font-size="10">{unit}</text>'
            yield f'<text x="{at}" y="{top + 45}" text-anchor="middle" font-size="9">{below}</text>'


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the table and the pictures, or check that they are as they would be written."""
    parser = argparse.ArgumentParser(prog="python docs/architecture_page.py", description=main.__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if something is out of date")
    check = parser.parse_args(arguments).check
    page = updated(PAGE.read_text(encoding="utf-8"), rooms(), BEGIN)
    new = {PAGE: page, LOOP: svg(332, list(loop())), FRAMES: svg(28 + FRAME_EVERY * 5, list(frames()))}
    old = [path for path, text in new.items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    for path in old:
        if check:
            print(f"{path.name} is out of date: run python docs/architecture_page.py")
        else:
            path.write_text(new[path], encoding="utf-8")
    return int(check and bool(old))


if __name__ == "__main__":
    sys.exit(main())
