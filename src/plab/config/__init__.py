"""Configuration of a run: types, composition, checks, and selection of runs.

:func:`load_config` composes the values of ``conf/*.yaml`` and overrides into a :class:`Config`. Names are
imported on first use, so that reading results does not import Hydra.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from plab.errors import ConfigError

if TYPE_CHECKING:
    from plab.config.compose import *
    from plab.config.run import *
    from plab.config.suite import choices, plab_folder
    from plab.config.task import *

__all__ = [
    "EXPERIMENT",
    "GROUPS",
    "BodyConfig",
    "Config",
    "ConfigError",
    "DrawConfig",
    "ManipulatorConfig",
    "MethodConfig",
    "ProtocolConfig",
    "RandomConfig",
    "SimConfig",
    "TargetsConfig",
    "TaskConfig",
    "build_scene",
    "choices",
    "drawn_configs",
    "load_config",
    "plab_folder",
]


def __getattr__(name: str) -> Any:
    """Import attributes on first access."""
    # Types first, because the import of compose needs them.
    for part in ("task", "run", "suite", "compose") if name in __all__ else ():
        module = import_module(f"{__name__}.{part}")
        if hasattr(module, name):
            return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
