"""Result files: one HDF5 file per run, replaced atomically during the run, and loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run in progress stores its state in
``<name>.partial.h5``, which is replaced atomically at intervals: after a kill, the previous version remains,
from which the same command resumes. Finished runs can be packed into archives, which load like folders. This
package imports pandas and DuckDB on demand, and neither torch nor Taichi, so that runs start fast.
"""

from plab.config.run import config_dict, config_hash
from plab.results.archive import pack, unpack
from plab.results.checking import check
from plab.results.run_file import ResultsError, RunBusyError, RunResult, read, write
from plab.results.run_table import Row, connect, load, read_curves, rows
from plab.results.running import RunFile

__all__ = [
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
    "pack",
    "read",
    "read_curves",
    "rows",
    "unpack",
    "write",
]
