"""``fes import``: public data sets, as downloaded, into recordings and references. ``fes trials``: the bundled ones."""

from pathlib import Path
from typing import Any

import click

from fes.cli.common import FAILED, PATH, SIDE, Problem, choice, fail, failing, writing
from fes.cli.show import print_json


@click.command(name="import")
@click.argument("name", metavar="NAME")
@click.argument("files", nargs=-1, type=PATH)
@click.option("--out", type=PATH, help="Folder for what is made.")
@choice("--format", "form", of=("parquet", "csv"))
@click.option("--foot", type=SIDE, help="Whose, where the data set does not say. Default: right.")
@click.option("--overwrite", is_flag=True, help="Replace what is there.")
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
def import_command(
    name: str, files: tuple[Path, ...], out: Path | None, form: str, foot: str | None, overwrite: bool, as_json: bool
) -> None:
    """Turn FILES (or a folder) of the data set NAME into recordings with sidecars, and references beside them.

    NAME is gaitmap, stroke_treadmill, pyshoe, ruler, broad, xio, footswitch_treadmill or stroke_walks, or what another
    package brings; `fes import list` says what each is. Units become SI, axes stay the sensors' own, known defects are
    noted in the sidecar. The data keeps its own licence, which is named.

    One file that cannot be used does not stop the others; the exit code is then 1 (2 if there was only one).
    """
    from fes.datasets import ImportProblem, data_set, data_sets, files_of, read_file, write_imported

    with failing(ImportProblem):
        known = data_sets() if name == "list" else {name: data_set(name)}
    if name == "list" and as_json:
        print_json({"data_sets": {each.name: {"about": each.about, **each.provenance()} for each in known.values()}})
        return
    if name == "list":
        for each in known.values():
            click.echo(f"{each.name:<21} {each.about}\n{'':<21} {each.source}; licence: {each.licence}")
        return
    if not files or out is None:
        what = "name the files of the data set (or their folder) and where to write"
        raise Problem(f"{what}: fes import NAME FILES --out DIR")
    about = known[name]
    made: list[dict[str, Any]] = []
    failures = 0
    with failing(ImportProblem):
        todo = files_of(name, files)
    for file in todo:
        try:
            imported = read_file(name, file, foot=foot)
            written = write_imported(imported, out, about.provenance(), form=form, overwrite=overwrite)
        except ImportProblem as error:
            if len(todo) == 1:
                fail(error)
            click.secho(f"Error: {error}", fg="red", err=True)
            failures += 1
            continue
        references = [str(path) for path in written[2:]]
        made.append({"recording": str(written[0]), "references": references, "notes": list(imported.notes)})
        if not as_json:
            click.echo(f"{written[0]}" + "".join(f"\n  reference {path.name}" for path in written[2:]))
            for note in imported.notes:
                click.echo(f"  note: {note}")
    if as_json:
        print_json({**about.provenance(), "made": made})
    else:
        click.echo(f"From {about.source}; licence: {about.licence}")
    if failures:
        click.secho(f"{failures} of {len(todo)} files could not be used.", fg="red", err=True)
        raise SystemExit(FAILED)


@click.command(name="trials")
@click.argument("folder", type=PATH)
@click.option("--only", help="One trial by name.")
def trials_command(folder: Path, only: str | None) -> None:
    """Write the bundled recordings, with their truth, to FOLDER; the same seeds give the same bytes."""
    try:
        from sim_inputs.generator.trials import main as generate
    except ImportError:
        what = "What makes the bundled recordings is part of the project's folder: run make trials there."
        raise Problem(what) from None
    with writing(folder, ". Choose another folder."):
        code = generate([str(folder), *(("--only", only) if only else ())])
    raise SystemExit(code)
