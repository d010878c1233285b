"""How docs/ becomes a site: notebooks read, contents made from docs/index.md, links that leave docs/ checked."""

import os
import re
from pathlib import Path
from typing import Any

import jupytext
from sphinx.application import Sphinx
from sphinx.util import logging

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
LINK = re.compile(r"\[([^\]\[]*)\]\(([^)\s]+)\)")
CODE = re.compile(r"^```.*?^```$|(?<!`)`[^`\n]+`(?!`)", re.MULTILINE | re.DOTALL)
NEEDS = re.compile(r"^# needs: (.+)\n")
HIDDEN = "\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{pages}\n```\n"
OWN = {"Reference": ("site/reference",)}  # made from the source, so in no list of files
log = logging.getLogger(__name__)


def read_notebook(text: str) -> Any:
    """A notebook of docs/notebooks, without the line that is for the tests."""
    notebook = jupytext.reads(NEEDS.sub("", text), fmt="py:percent")
    notebook.metadata["language_info"] = {"name": "python", "pygments_lexer": "python3"}  # also where it is not run
    return notebook


def not_run() -> list[str]:
    """Notebooks whose recordings are not on this machine: they are shown without results."""
    missing = []
    for path in sorted((DOCS / "notebooks").glob("*.py")):
        found = NEEDS.match(path.read_text(encoding="utf-8"))
        if found and not all((DATA / name).is_dir() for name in found[1].split(", ")):
            missing.append(f"notebooks/{path.name}")
    return missing


def contents(text: str) -> str:
    """The lists of docs/index.md as the site's contents, a part for each heading."""
    parts = []
    for part in text.split("\n## ")[1:]:
        caption = part.partition("\n")[0]
        pages = [target for _, target in LINK.findall(part) if target.endswith(".md")]
        parts.append(HIDDEN.format(caption=caption, pages="\n".join([*pages, *OWN.get(caption, ())])))
    return text + "".join(parts)


def outside_links(text: str, page: Path) -> str:
    """Links to files of the project that are no pages: they must be there, and are shown as their names."""

    def shown(found: re.Match[str]) -> str:
        words, target = found[1], found[2]
        if "://" in target or target.startswith(("#", "mailto:")):
            return found[0]
        file = (page.parent / target.partition("#")[0]).resolve()
        if file.is_relative_to(DOCS) and file.suffix in (".md", ".svg", ".png"):
            return found[0]
        if file.is_relative_to(DOCS / "notebooks"):
            return found[0]
        if not file.exists() or not file.is_relative_to(ROOT):
            log.warning("%s: link to %s leads nowhere", page.name, target)
        name = file.relative_to(ROOT).as_posix() if file.is_relative_to(ROOT) else target
        return f"{words} (`{name}`)" if name not in words else words

    said, begin = [], 0
    for code in CODE.finditer(text):
        # a name in code marks may be a link's words: those stay with their link
        if text[code.start() - 1 : code.start()] == "[" and text[code.end() : code.end() + 2] == "](":
            continue
        said += [LINK.sub(shown, text[begin : code.start()]), code[0]]
        begin = code.end()
    return "".join((*said, LINK.sub(shown, text[begin:])))


def on_source(app: Sphinx, name: str, source: list[str]) -> None:
    """Before a page is parsed."""
    page = Path(app.env.doc2path(name))
    if page.suffix == ".md" and page.parent == DOCS:
        source[0] = outside_links(source[0], page)
        if name == "index":
            source[0] = contents(source[0])
        if name == "notebooks":
            listed = sorted(f"notebooks/{path.stem}" for path in (DOCS / "notebooks").glob("*.py"))
            source[0] += HIDDEN.format(caption="Notebooks", pages="\n".join(listed))
