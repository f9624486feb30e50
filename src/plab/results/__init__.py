"""Result files: one HDF5 file per run, replaced atomically while it runs, loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run in progress stores its state in
``<name>.partial.h5``, which is replaced atomically at intervals: after a kill, the previous version remains,
from which the same command resumes. Finished runs can be packed into archives, which load like folders. This
package does not import torch or Taichi, and pandas and DuckDB on demand, so that runs start fast.
"""

from plab.config.run import config_dict, config_hash
from plab.config.selection import lookup
from plab.results.archive import pack, unpack
from plab.results.checking import Fault, check
from plab.results.query import connect
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
from plab.results.table import Row, load, read_curves, rows

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
