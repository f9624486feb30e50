"""plab: a benchmark for soft-body manipulation with differentiable physics."""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
from importlib import import_module
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

if _IS_COMMAND := (
    (_words := [os.path.basename(word) for word in sys.orig_argv[1:3]])[:1] == ["plab"]
    or (_words[:1] == ["-m"] and _words[-1].partition(".")[0] == "plab")
):
    # Ctrl-C ends a command without a traceback until plab.cli.command handles it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Imports and compilation allocate many long-lived objects; frequent collection would take seconds.
    gc.set_threshold(100_000)

# Set before Taichi is imported: otherwise it prints a banner on standard output, and sends version, platform
# and an id to its developers.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("ENABLE_QUADRANTS_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
if os.name == "posix" and "HOME" not in os.environ:
    # Taichi aborts without it.
    os.environ["HOME"] = next(filter(os.path.isdir, (os.path.expanduser("~"), tempfile.gettempdir())))

from plab.config.suite import suite_tasks

if TYPE_CHECKING:
    from plab.config import build_scene, load_config
    from plab.envs import make, make_vec
    from plab.problem import make_simulator
    from plab.results import load as load_results
    from plab.scenes import Scene
    from plab.sim import Simulator

__all__ = [
    "TASKS",
    "Scene",
    "Simulator",
    "__version__",
    "build_scene",
    "load_config",
    "load_results",
    "make",
    "make_simulator",
    "make_vec",
]

__version__ = "0.2.0"

TASKS = tuple(suite_tasks())
"""Names of the suite's tasks."""

_PLACES = {
    "Scene": "plab.scenes:Scene",
    "Simulator": "plab.sim:Simulator",
    "build_scene": "plab.config:build_scene",
    "load_config": "plab.config:load_config",
    "load_results": "plab.results:load",
    "make": "plab.envs:make",
    "make_vec": "plab.envs:make_vec",
    "make_simulator": "plab.problem:make_simulator",
}
"""Module and name of each part that is imported on first use: Taichi and pandas take seconds."""

if not _IS_COMMAND:
    # Registers the environments; commands do without Gymnasium, which takes a tenth of a second.
    import_module("plab.envs")


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'plab' has no attribute '{name}'")
    return resolve_name(_PLACES[name])


def __dir__() -> list[str]:
    return sorted(__all__)
