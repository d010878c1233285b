"""``fes trials``: generate the bundled recordings anew."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(name="trials")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--only", help="One trial by name.")
def command(folder: Path, only: str | None) -> None:
    """Write the bundled recordings, with their truth, to FOLDER; the same seeds give the same bytes."""
    from fes.patient.trials import main as generate

    raise SystemExit(generate([str(folder), *(("--only", only) if only else ())]))
