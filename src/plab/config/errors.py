"""One-line explanations of what Hydra and OmegaConf reject, with the names that would do."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    KeyValidationError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from yaml import MarkedYAMLError, YAMLError

from plab.errors import pick

__all__ = ["COMPOSE_ERRORS", "explain"]

COMPOSE_ERRORS = (HydraException, OmegaConfBaseException, YAMLError, RecursionError)
"""What composing a configuration raises where the configuration is wrong."""


LAUNCHER_EXTRAS = {
    "joblib": "joblib",
    "ray": "ray",
    "submitit_local": "submitit",
    "submitit_slurm": "submitit",
}
"""Launchers of other packages, to the extra of plab that installs them."""


def explain(error: HydraException | OmegaConfBaseException | YAMLError | RecursionError) -> str:
    """Return one line, without a full stop, on an error of Hydra's, OmegaConf's or YAML's."""
    if isinstance(error, RecursionError):
        return (
            "the configuration refers to itself, or is nested too deeply: look at defaults, ${...}, brackets"
        )
    launcher = re.search(r"Could not (?:load|find) 'hydra/launcher/(\w+)'", str(error))
    if launcher and launcher[1] in LAUNCHER_EXTRAS:
        return f"this launcher is not installed: pip install 'plab[{LAUNCHER_EXTRAS[launcher[1]]}]'"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return f"{group} '{name}' does not exist; {pick(name, error.options)}"
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return f"{mark.name}, line {mark.line + 1}: {error.problem}"
    if isinstance(error, OverrideParseException):
        return f"cannot read '{error.override}': write key=value, and quote values with special characters"
    cause = _omegaconf_cause(error)
    file = re.match(r"In '(.+)': \w+ raised", str(error))
    if file and cause is not None:
        return f"{file[1]}.yaml: {explain(cause)}"
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return _unknown_key(cause)
    if isinstance(cause, KeyValidationError):
        return f"{cause.full_key}: put the name into quotes"
    if isinstance(cause, MissingMandatoryValue):
        return f"{cause.full_key} has no value: give one"
    if cause is not None:
        place = f"{cause.full_key}: " if cause.full_key else ""
        return place + (cause.msg or str(cause)).strip().splitlines()[0]
    message = str(error)
    return "; ".join(line.strip() for line in message.splitlines() if line.strip())


def _omegaconf_cause(error: BaseException | None) -> OmegaConfBaseException | None:
    while error is not None and not isinstance(error, OmegaConfBaseException):
        # Hydra raises some of its errors while it handles another, without naming it as the cause.
        error = error.__cause__ or error.__context__
    return error


def _unknown_key(error: OmegaConfBaseException) -> str:
    parent = error.parent_node
    key = str(error.full_key or error.key)
    last = key.rpartition(".")[2]
    names = [str(name) for name in parent if name != "hydra"] if isinstance(parent, DictConfig) else []
    # lr=0.1 instead of method.lr=0.1: name the key that ends like it.
    deeper = [path for path in _paths(parent) if path.rpartition(".")[2] == last] if "." not in key else []
    if deeper:
        return f"unknown key '{key}'; did you mean {' or '.join(deeper[:3])}? choose from: {', '.join(names)}"
    return f"unknown key '{key}'; {pick(last, names)}"


def _paths(node: object, prefix: str = "") -> Iterator[str]:
    """Dotted paths of all keys of dataclass nodes below a node, and of a method that has no type yet."""
    if not isinstance(node, DictConfig):
        return
    if prefix != "method." and not dataclasses.is_dataclass(OmegaConf.get_type(node)):
        return
    for key in map(str, node):
        if key != "hydra":
            yield f"{prefix}{key}"
            if not OmegaConf.is_missing(node, key) and not OmegaConf.is_interpolation(node, key):
                yield from _paths(node[key], f"{prefix}{key}.")
