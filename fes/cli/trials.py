"""``fes trials``: generate the bundled recordings anew."""

from __future__ import annotations

from pathlib import Path

import click

from fes.cli.common.exits import Problem


@click.command(name="trials")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--only", help="One trial by name.")
def command(folder: Path, only: str | None) -> None:
    """Write the bundled recordings, with their truth, to FOLDER; the same seeds give the same bytes."""
    try:
        from sim_inputs.generator.trials import main as generate
    except ImportError:
        raise Problem(
            "What makes the bundled recordings is part of the project's folder: run make trials there."
        ) from None

    try:
        code = generate([str(folder), *(("--only", only) if only else ())])
    except OSError as error:
        raise Problem(f"{folder}: cannot be written: {error.strerror}. Choose another folder.") from error
    raise SystemExit(code)
