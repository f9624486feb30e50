"""Result files: one HDF5 file per run, replaced atomically during the run, and loaded into pandas afterwards.

The layout is described in docs/developers/format.md. A run in progress stores its state in
``<name>.partial.h5``, which is replaced atomically at intervals: after a kill, the previous version remains,
from which the same command resumes. Finished runs can be packed into archives, which load like folders. This
package does not import torch or Taichi, and imports the modules that read many results on demand, so that
runs start fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from plab.config.run import config_dict, config_hash
from plab.results.run_file import (
    BUDGETS,
    SCHEMA_VERSION,
    ResultsError,
    RunBusyError,
    RunResult,
    read,
    row_count,
    write,
)
from plab.results.running import RunFile

if TYPE_CHECKING:
    from plab.results.archive import pack, unpack
    from plab.results.checking import check
    from plab.results.run_table import Row, connect, load, read_curves, rows

__all__ = [
    "BUDGETS",
    "SCHEMA_VERSION",
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
    "row_count",
    "rows",
    "unpack",
    "write",
]

_MODULES = {
    "archive": ("pack", "unpack"),
    "checking": ("check",),
    "run_table": ("Row", "connect", "load", "read_curves", "rows"),
}
"""Exported names by module, imported on first use."""


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"plab.results.{module}"), name)
    raise AttributeError(f"module 'plab.results' has no attribute '{name}'")
