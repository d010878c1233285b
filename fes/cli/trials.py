"""``fes trials``: generate the bundled recordings anew."""

from pathlib import Path

import click

from fes.cli.common.exits import Problem, writing
from fes.cli.common.options import PATH


@click.command(name="trials")
@click.argument("folder", type=PATH)
@click.option("--only", help="One trial by name.")
def command(folder: Path, only: str | None) -> None:
    """Write the bundled recordings, with their truth, to FOLDER; the same seeds give the same bytes."""
    try:
        from sim_inputs.generator.trials import main as generate
    except ImportError:
        what = "What makes the bundled recordings is part of the project's folder: run make trials there."
        raise Problem(what) from None
    with writing(folder, ". Choose another folder."):
        code = generate([str(folder), *(("--only", only) if only else ())])
    raise SystemExit(code)
