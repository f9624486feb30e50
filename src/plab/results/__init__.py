"""Result files: one HDF5 file per run, replaced atomically while it runs, loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run that is under way keeps its state in
``<name>.partial.h5``, rewritten as a whole now and then: a process killed at any moment leaves the previous,
readable version behind, from which the same command resumes. Finished runs can be packed into archives, which
load like folders; ``python -m plab.results`` packs, checks and shows scores. What is loaded is kept in a
database (``database.py``), for the next time and for SQL. This package imports neither torch nor taichi, so
that reading results is quick.
"""

from plab.config.selection import lookup
from plab.results.archive import pack, unpack
from plab.results.checking import Problem, check
from plab.results.curves import read_curves
from plab.results.database import Row
from plab.results.files import read, read_iterations, write
from plab.results.loading import load, rows
from plab.results.query import connect
from plab.results.running import RunFile
from plab.results.schema import (
    BUDGETS,
    SCHEMA_VERSION,
    STATUSES,
    NewerSchemaError,
    ResultsError,
    RunBusyError,
    RunResult,
    config_dict,
    config_hash,
    result_path,
    row_count,
)

__all__ = [
    "BUDGETS",
    "SCHEMA_VERSION",
    "STATUSES",
    "NewerSchemaError",
    "Problem",
    "ResultsError",
    "Row",
    "RunBusyError",
    "RunFile",
    "RunResult",
    "check",
    "config_dict",
    "config_hash",
    "connect",
    "load",
    "lookup",
    "pack",
    "read",
    "read_curves",
    "read_iterations",
    "result_path",
    "row_count",
    "rows",
    "unpack",
    "write",
]
