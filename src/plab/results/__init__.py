"""Result files: one HDF5 file per run, replaced atomically while it runs, loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run in progress stores its state in
``<name>.partial.h5``, which is replaced atomically at intervals: after a kill, the previous version remains,
from which the same command resumes. Finished runs can be packed into archives, which load like folders. This
package does not import torch or Taichi, so that reading results is fast.
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
    """Import functions for many results on demand, because runs do not need them or pandas."""
    if name in _LAZY:
        return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
