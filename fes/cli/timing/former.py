"""``fes replay --check-timing``, as it was called once: passed on to ``fes timing check``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click

from fes.cli.common.exits import Problem
from fes.cli.common.options import PATH

_OPTIONS: Final[dict[str, dict[str, Any]]] = {
    "check_timing": {"is_flag": True},
    "against": {"type": PATH},
    "tolerance_ms": {},
    "latency_budget_ms": {},
    **{f"max_{name}": {"type": click.IntRange(min=0)} for name in ("missed", "extra", "early", "late")},
}
PARAMETERS: Final = tuple(_OPTIONS)


def former_timing_options(function: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options that ``fes timing check`` has taken over; ``--check-timing`` runs that instead."""

    @functools.wraps(function)
    def with_former_options(recording: Path, **kwargs: Any) -> None:
        chosen = {name: kwargs.pop(name) for name in PARAMETERS}
        if not chosen.pop("check_timing"):
            if idle := [name.replace("_", "-") for name, value in chosen.items() if value is not None]:
                raise Problem(f"--{idle[0]} belongs to the check of timing, which is `fes timing check` now.")
            function(recording=recording, **kwargs)
            return
        moved = [chosen[name] for name in ("max_early", "max_late") if chosen[name] is not None]
        arguments = [str(recording)]
        for option, value in (
            ("--truth", chosen["against"]),
            ("--session", kwargs["session"]),
            ("--calibration", kwargs["calibration"]),
            ("--tolerance-ms", chosen["tolerance_ms"]),
            ("--latency-budget-ms", chosen["latency_budget_ms"]),
            *(("--allow", _allowed(name, chosen[f"max_{name}"])) for name in ("missed", "extra")),
            ("--allow", f"moved={sum(moved)}" if moved else None),
            ("--out", kwargs["out"]),
        ):
            arguments += [option, str(value)] if value is not None else []
        arguments += ["--json"] if kwargs["as_json"] else []
        arguments += ["--no-report"] if kwargs["no_report"] else []
        shown = " ".join(arguments[:1] + [each for each in arguments[1:] if each not in ("--out", str(kwargs["out"]))])
        click.secho(f"fes replay --check-timing is now: fes timing check {shown}", fg="yellow", err=True)
        from fes.cli.timing.command import check_command

        check_command.main(arguments, prog_name="fes timing check", standalone_mode=False)

    for name, settings in reversed(_OPTIONS.items()):
        with_former_options = click.option(f"--{name.replace('_', '-')}", hidden=True, **settings)(with_former_options)
    return with_former_options


def _allowed(name: str, count: int | None) -> str | None:
    return None if count is None else f"{name}={count}"
