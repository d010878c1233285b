"""A simulated walker with an IMU on each foot, and the truth beside every sample.

And where the bundled recordings are: ``sim_inputs`` in a checkout, or the few of them that the wheel carries.
"""

from pathlib import Path


def bundled_file(name: str) -> Path:
    """Return the path of a file of ``sim_inputs``, as ``negard_patient2.parquet`` or ``session.toml``.

    Raises:
        FileNotFoundError: there is none of that name; the message lists what there is.
    """
    from importlib.resources import as_file, files

    with as_file(files("fes")) as package:
        # the wheel carries its few within the package; in a checkout the folder stands beside it
        folders = [folder for folder in (package / "sim_inputs", package.parent / "sim_inputs") if folder.is_dir()]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    there = sorted(path.name for folder in folders for path in folder.iterdir() if path.suffix in (".parquet", ".csv"))
    raise FileNotFoundError(f"{name}: not among the bundled files: {', '.join(there) or 'there are none'}")
