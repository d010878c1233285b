"""Frozen values made fast: the same as Python's own, but for the time that making one takes."""

from __future__ import annotations

import copy
import inspect
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, replace
from typing import Any

import pytest

from fes.signals import ImuSample, StimCommand, StimRequest, StrideResult
from fes.values import quick
from statemachine.phases import PhaseChange


@dataclass(frozen=True, slots=True)
class Plain:
    t_ns: int
    name: str
    size: float = 1.5
    parts: list[int] = field(default_factory=list)


@quick
@dataclass(frozen=True, slots=True)
class Quick:
    t_ns: int
    name: str
    size: float = 1.5
    parts: list[int] = field(default_factory=list)


@pytest.mark.parametrize(
    ("given", "named"), [((1, "a"), {}), ((1, "a", 2.5, [3]), {}), ((1,), {"name": "b", "parts": [4]})]
)
def test_it_is_what_python_makes(given: tuple[Any, ...], named: dict[str, Any]) -> None:
    made, own = Quick(*given, **named), Plain(*given, **named)
    assert type(made) is Quick
    assert repr(made) == repr(own).replace("Plain", "Quick")
    assert made == Quick(*given, **named)
    assert made == copy.copy(made) == copy.deepcopy(made) == pickle.loads(pickle.dumps(made))
    changed = replace(made, t_ns=7)
    assert (changed.t_ns, changed.name, changed.size, changed.parts) == (7, own.name, own.size, own.parts)


def test_each_has_its_own_of_what_is_made_anew() -> None:
    assert Quick(1, "a").parts is not Quick(1, "a").parts


def test_arguments_are_asked_for_as_by_python() -> None:
    assert inspect.get_annotations(Quick.__init__) == inspect.get_annotations(Plain.__init__)
    assert list(inspect.signature(Quick).parameters) == list(inspect.signature(Plain).parameters)
    make: Any = Quick
    for wrong in ((), (1,), (1, "a", 2.0, [], 5)):
        with pytest.raises(TypeError, match="__init__"):
            make(*wrong)


@pytest.mark.parametrize("kind", [Quick, ImuSample, StimRequest, StimCommand, StrideResult, PhaseChange])
def test_nothing_of_it_can_be_changed(kind: type[Any]) -> None:
    names = list(inspect.signature(kind).parameters)
    made = kind(*range(len(names)))
    for name in names:
        with pytest.raises(FrozenInstanceError):
            setattr(made, name, 5)
        with pytest.raises(FrozenInstanceError):
            delattr(made, name)
    with pytest.raises((FrozenInstanceError, TypeError)):
        made.__class__ = Plain
    assert [getattr(made, name) for name in names] == list(range(len(names)))


def test_what_it_does_not_know_it_refuses() -> None:
    @dataclass(frozen=True, slots=True)
    class Checked:
        a: int

        def __post_init__(self) -> None:
            raise AssertionError

    @dataclass(frozen=True, slots=True)
    class Derived:
        a: int
        b: int = field(init=False, default=2)

    @dataclass(frozen=True)
    class Open:
        a: int

    for kind in (Checked, Derived, Open):
        with pytest.raises(TypeError, match="plain"):
            quick(kind)


def test_what_is_derived_from_it_cannot_be_made() -> None:
    class Derived(Quick):
        pass

    with pytest.raises(TypeError, match="layout"):
        Derived(1, "a")
