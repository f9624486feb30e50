"""Result files: one HDF5 file per run, replaced atomically while it runs, loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run that is under way keeps its state in
``<name>.partial.h5``, rewritten as a whole now and then: a process killed at any moment leaves the previous,
readable version behind, from which the same command resumes. Finished runs can be packed into archives, which
load like folders. This package imports neither torch nor taichi, so that reading results is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from plab.config.run import config_dict, config_hash
from plab.config.selection import lookup
from plab.results.running import RunFile, read, write
from plab.results.schema import (
    BUDGETS,
    SCHEMA_VERSION,
    STATUSES,
    NewerSchemaError,
    ResultsError,
    RunBusyError,
    RunResult,
    row_count,
)

if TYPE_CHECKING:
    from plab.results.archive import pack, unpack
    from plab.results.checking import Fault, check
    from plab.results.query import connect
    from plab.results.table import Row, load, read_curves, rows

_LAZY = {
    **dict.fromkeys(("Row", "load", "read_curves", "rows"), "table"),
    **dict.fromkeys(("pack", "unpack"), "archive"),
    **dict.fromkeys(("Fault", "check"), "checking"),
    "connect": "query",
}

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
    "row_count",
    "rows",
    "unpack",
    "write",
]


def __getattr__(name: str) -> Any:
    """Import functions for many results on demand: a run does without them, and without pandas."""
    if name in _LAZY:
        return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
