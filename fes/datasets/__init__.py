"""Public data sets, as downloaded, into recordings with references that `fes evaluate` takes.

Nothing of them is part of this project: the licence of each is named wherever its data goes.
"""

from fes.datasets.common import (
    DATA_SETS,
    DataSet,
    Imported,
    ImportProblem,
    data_set,
    data_sets,
    files_of,
    read_file,
    write_imported,
)

__all__ = [
    "DATA_SETS", "DataSet", "ImportProblem", "Imported", "data_set", "data_sets", "files_of", "read_file",
    "write_imported",
]  # fmt: skip
