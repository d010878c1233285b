"""Compiled templates are kept, made anew when a template changes, and done without where nothing can be kept."""

from __future__ import annotations

from pathlib import Path

import pytest
from jinja2 import DictLoader, Environment

from fes.report.html import TemplateCache


def rendered(text: str) -> str:
    environment = Environment(loader=DictLoader({"page": text}), autoescape=True, bytecode_cache=TemplateCache())
    return environment.get_template("page").render(name="Ann")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "fes-gait" / "templates"


def test_what_is_compiled_is_kept_until_the_template_changes(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rendered("Hello {{ name }}") == "Hello Ann"
    assert len(list(cache.iterdir())) == 1
    with monkeypatch.context() as without_compiler:
        without_compiler.setattr(Environment, "compile", None)
        assert rendered("Hello {{ name }}") == "Hello Ann"
        with pytest.raises(TypeError):
            rendered("Good bye {{ name }}")
    assert rendered("Good bye {{ name }}") == "Good bye Ann"


def test_what_is_damaged_is_compiled_anew(cache: Path) -> None:
    rendered("Hello {{ name }}")
    for kept in cache.iterdir():
        kept.write_bytes(b"rubbish")
    assert rendered("Hello {{ name }}") == "Hello Ann"


@pytest.mark.parametrize("in_the_way", ["fes-gait", "fes-gait/templates"])
def test_where_nothing_can_be_kept_it_works_without(cache: Path, tmp_path: Path, in_the_way: str) -> None:
    place = tmp_path / in_the_way
    place.parent.mkdir(exist_ok=True)
    place.write_text("a file where a folder should be", encoding="utf-8")
    assert rendered("Hello {{ name }}") == "Hello Ann"
    assert place.is_file()


def test_a_user_without_a_home_gets_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("no home")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    assert rendered("Hello {{ name }}") == "Hello Ann"
