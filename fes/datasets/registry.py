"""The data sets by name: what each is, under which licence, and the module that reads it."""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fes.datasets.common import Imported, ImportProblem
from fes.extensions import ExtensionError, extension_names, load_extension


@dataclass(frozen=True, slots=True)
class DataSet:
    """One data set.

    ``looks_like``: names (patterns) of files, or of folders of one run, searched for in a folder. ``reader``: module
    and function, where that is not the set's own module. ``read``: the function itself, of a data set that another
    package brings: ``read(path, foot)`` → :class:`fes.datasets.Imported`.
    """

    name: str
    about: str
    source: str
    licence: str
    looks_like: tuple[str, ...]
    reader: str = ""
    read: Callable[[Path, str | None], Imported] | None = None

    def provenance(self) -> dict[str, str]:
        """For the sidecar of everything that comes from it."""
        return {"data_set": self.name, "source": self.source, "licence": self.licence}


_SETS: Final = (
    DataSet(
        "gaitmap",
        "1 healthy adult, lateral shoes 204.8 Hz; markers on heel and toe, IC and FO; stairs",
        "example data of gaitmap (MaD-Lab Erlangen)",
        "MIT",
        ("imu_sample*.csv",),
    ),
    DataSet(
        "stroke_treadmill",
        "stroke survivors on a treadmill, feet and shanks 100 Hz (folders of Xsens texts, or packed); belt speed",
        "Sint Maartenskliniek, MovingReality; cite 10.3390/s24020710",
        "MIT",
        ("MR*.npz", "exported[0-9]*"),
    ),
    DataSet(
        "pyshoe",
        "healthy walks, right instep 200 Hz; Vicon position at every sample",
        "PyShoe (Wagstaff, Peretroukhin, Kelly), Vicon part",
        "copy under MIT; the original's licence is not known: measure and quote, pass nothing on",
        ("*.mat",),
        "measured_walks.read_pyshoe",
    ),
    DataSet(
        "ruler",
        "walks, one foot 200 Hz; every footprint measured by ruler",
        "mtahakoroglu/gait-driven-inertial-navigation-dataset",
        "MIT",
        ("*_LLIO.mat",),
        "measured_walks.read_ruler",
    ),
    DataSet(
        "broad",
        "a board moved by hand (not gait), 285.7 Hz; optical orientation and position",
        "dlaidig/broad",
        "CC BY 4.0 (name the authors)",
        ("*.hdf5", "*.mat"),
    ),
    DataSet(
        "xio",
        "one foot, nominally 400 Hz; a loop that ends where it starts",
        "xioTechnologies/Gait-Tracking",
        "MIT",
        ("*walk.csv",),
    ),
    DataSet(
        "footswitch_treadmill",
        "healthy and hemiparetic walkers on a treadmill, one instep about 194 Hz; the four phases by footswitches",
        "midasama3124/hmm_gait_phase_classifier; cite 10.3390/s19132988",
        "BSD",
        ("[HP][0-9]*_[0-9].npz",),
        "packed_walks.read_footswitch_treadmill",
    ),
    DataSet(
        "stroke_walks",
        "stroke survivors and healthy walkers, two minutes on the floor with turns, both feet 104 Hz; no reference",
        "RichardFel/VAE (Zenodo 8073887)",
        "MIT",
        ("S[0-9]*.npz",),
        "packed_walks.read_stroke_walks",
    ),
)
DATA_SETS: Final = {each.name: each for each in _SETS}


def data_sets() -> dict[str, DataSet]:
    """By name, the data sets known here and those that installed packages bring; ours go first where names meet.

    ImportProblem: what a package brings is no data set.
    """
    found = dict(DATA_SETS)
    for name in extension_names("importer"):
        if name not in found:
            found[name] = _other(name)
    return found


def _other(name: str) -> DataSet:
    try:
        found = load_extension("importer", name)
    except ExtensionError as error:
        raise ImportProblem(str(error)) from error
    if not isinstance(found, DataSet) or found.read is None or found.name != name:
        raise ImportProblem(f"importer {name!r} must be a DataSet of this name with a read function")
    return found


def data_set(name: str) -> DataSet:
    """One of :func:`data_sets`. Raises ImportProblem: there is none of this name."""
    known = data_sets() if name not in DATA_SETS else DATA_SETS
    if name not in known:
        raise ImportProblem(f"{name}: is no data set known here; {', '.join(known)} are")
    return known[name]


def files_of(name: str, paths: Sequence[Path]) -> list[Path]:
    """The files to read; a folder stands for all files in it that look like the data set's.

    ImportProblem: the set is not known, or nothing of it is there.
    """
    looks_like = data_set(name).looks_like
    found = []
    for path in paths:
        if not path.exists():
            raise ImportProblem(f"{path}: is not there. Name the files of the data set, or their folder.")
        shapes = looks_like
        one = not path.is_dir() or any(path.resolve().match(shape) for shape in shapes)
        files = [path] if one else sorted({file for shape in shapes for file in path.rglob(shape)})
        if not files:
            raise ImportProblem(f"{path}: holds no file like {', '.join(shapes)}")
        found += files
    return found


def read_file(name: str, path: Path, *, foot: str | None = None) -> Imported:
    """Read one file of a data set, with what belongs to it.

    ``foot`` says whose a sensor is of which the data set does not tell.

    ImportProblem: it is none of its files.
    """
    known = data_set(name)
    if known.read is not None:
        return known.read(path, foot)
    module, _, function = (known.reader or f"{name}.read").partition(".")
    read: Callable[[Path, str | None], Imported] = getattr(importlib.import_module(f"fes.datasets.{module}"), function)
    return read(path, foot)
