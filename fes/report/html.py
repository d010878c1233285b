"""The way to an HTML page: templates, style sheets and scripts, escaping, and the file written whole or not at all."""

import json
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from fes import __version__
from fes.report.text import local_time, mean_sd, number, plain, readable, slug


class ReportError(OSError):
    """A report cannot be written; the message names the file and what to do, ``strerror`` why."""


@cache
def templates(package: str = "fes.report") -> Environment:
    """The templates of a package, with the filters that all of them use."""
    environment = Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = {"num": number, "mean_sd": mean_sd, "readable": readable, "local_time": local_time, "slug": slug}
    environment.filters |= filters
    return environment


def rendered(name: str, package: str = "fes.report", **values: object) -> str:
    """A page as text, with what all of them have in common: the style sheet and the version."""
    common = {"style": Markup(asset("report.css")), "version": __version__}
    return templates(package).get_template(name).render(**common | values)


@cache
def asset(name: str) -> str:
    """A style sheet or script of the report."""
    return files("fes.report").joinpath("static", name).read_text(encoding="utf-8")


def embed(value: object) -> str:
    """JSON that cannot end the script element it stands in, whatever its strings hold."""
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def css_text(text: str) -> str:
    """Any text as a string of a style sheet: everything but plain letters and figures is escaped by its number."""
    return '"' + "".join(c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in text) + '"'


def write_page_file(text: str, path: Path, remedy: str) -> None:
    """Write a page, replacing an older one; folders are made. ``remedy``: what to do if it cannot be, as a sentence.

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
