"""Result files: one HDF5 file per run, replaced atomically while it runs, loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run that is under way keeps its state in
``<name>.partial.h5``, rewritten as a whole now and then: a process killed at any moment leaves the previous,
readable version behind, from which the same command resumes. Finished runs can be packed into archives, which
load like folders; ``python -m plab.results`` packs, checks and shows scores. Loaded rows are kept in an index
(``index.py``); DuckDB answers SQL. This package imports neither torch nor taichi, so that reading results is
quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from plab.config.selection import lookup
from plab.results.files import read, read_iterations, write
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

if TYPE_CHECKING:
    from plab.results.archive import pack, unpack
    from plab.results.checking import Fault, check
    from plab.results.index import Row
    from plab.results.loading import load, read_curves, rows
    from plab.results.query import connect

__all__ = [
    "BUDGETS",
    "SCHEMA_VERSION",
    "STATUSES",
    "Fault",
    "NewerSchemaError",
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


def __getattr__(name: str) -> Any:
    """Import what is for many results when it is asked for: a run does without it, and without pandas."""
    parts = ("index", "loading", "archive", "checking", "query")
    for part in parts if name in __all__ else ():
        module = import_module(f"{__name__}.{part}")
        if name in module.__all__:
            return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
