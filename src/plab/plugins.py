"""Loading of objects named as ``module:NAME`` in a configuration, from plab or from external files.

Modules are searched for in Python's path, then in the config folder (``--config-dir``), its parent folder and
the working directory.
Results record only the text, which does not depend on the computer.
"""

from __future__ import annotations

import os
import sys
from collections import UserDict
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from plab.errors import ConfigError, describe_error, suggest

Kind = TypeVar("Kind")


class LazyModule(ModuleType):
    """A module that is imported on first access to an attribute."""

    def __getattr__(self, name: str) -> Any:
        """Import the module, and cache the object."""
        value = getattr(import_module(self.__name__), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import duckdb
    import pandas
    import scipy
    import torch
    from torch import Tensor
else:
    duckdb, pandas, scipy, torch = map(LazyModule, ("duckdb", "pandas", "scipy", "torch"))
    # For annotations only, which are not evaluated.
    Tensor = Any


class Registry(UserDict[str, Any]):
    """Named objects, given as ``module:NAME`` and imported on first access."""

    def __init__(self, kind: type, places: Mapping[str, str]) -> None:
        """Store the ``module:NAME`` of instances of ``kind`` (``type`` for classes) by name."""
        super().__init__(places)
        self._kind = kind

    def __getitem__(self, name: str) -> Any:
        if isinstance(self.data[name], str):
            self.data[name] = load_object(self.data[name], self._kind)
        return self.data[name]

    def find(self, name: str, key: str) -> Any:
        """Return the object with a name in the registry, or any ``module:NAME``; raise ConfigError, which
        names the configuration key, if it does not exist."""
        if ":" in name:
            return load_object(name, self._kind)
        if name not in self:
            raise ConfigError(f"{key} '{name}' does not exist; {suggest(name, [*self, 'module:NAME'])}")
        return self[name]


def search_in(config_dir: str | Path) -> None:
    """Append a config folder and its parent folder to the module path for the rest of the process."""
    folder = Path(config_dir).resolve()
    # At the end, so that user files do not hide modules of Python or plab.
    sys.path += [path for path in (str(folder), str(folder.parent)) if path not in sys.path]


def export_module_path() -> None:
    """Export the module path to processes started later by this process."""
    # Python's own folders are left out, because the other process may use another version.
    own = [path for path in sys.path if path and not path.startswith((sys.prefix, sys.base_prefix))]
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys([*own, *filter(None, before)]))


def load_object(text: str, kind: type[Kind]) -> Kind:
    """Return the object that ``module:NAME`` refers to, an instance of ``kind`` (``type`` for classes); raise
    ConfigError if it cannot be imported or is of another kind."""
    module_name, _, name = text.partition(":")
    if not (name.isidentifier() and all(part.isidentifier() for part in module_name.split("."))):
        raise ConfigError(f"'{text}' does not name an object: write module:NAME")
    module = _imported(text, module_name)
    if not hasattr(module, name):
        raise ConfigError(f"'{text}': {module.__file__} has no {name}")
    found = getattr(module, name)
    if not isinstance(found, kind):
        raise ConfigError(f"'{text}' must be a {kind.__name__}, not a {type(found).__name__}")
    return found


def _imported(text: str, name: str) -> ModuleType:
    if name.partition(".")[0] != "plab":
        # Registers plab's environments, which the module may create.
        import_module("plab.envs")
        # The working directory, which only ``python -m plab`` searches by itself.
        sys.path += [""] * ("" not in sys.path)
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if name == missing or name.startswith(f"{missing}."):
            places = "in the config folder, its parent folder, the working directory or PYTHONPATH"
            raise ConfigError(f"'{text}': there is no module {missing} {places}") from None
        raise ConfigError(f"'{text}': module {name} needs {missing}, which is not installed") from None
    except SyntaxError as error:
        raise ConfigError(f"'{text}': {error.filename}, line {error.lineno}: {error.msg}") from None
    except Exception as error:
        raise ConfigError(f"'{text}': {describe_error(error)[0]}") from error
