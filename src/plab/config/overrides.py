"""Overrides in Hydra's grammar: preparation, parsing, expansion of sweeps, and error messages."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, IntervalSweep, Override
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import MarkedYAMLError, YAMLError

from plab.config.selection import leaves
from plab.config.suite import EXTENSION_TASKS
from plab.errors import ConfigError, suggest

RANDOM = "random"
"""Name of the random variant."""

_YAML_NUMBER = re.compile(r"(?<=[=,:\[ ])([-+]?)\.(inf|nan)(?=$|[,\]} ])", re.IGNORECASE)
"""Infinity and NaN in YAML notation."""


def prepared(words: Sequence[str]) -> list[str]:
    """Return overrides in the form that Hydra reads: names of folders and files quoted, ``.inf`` as ``inf``;
    raise ConfigError for anything but a list of strings."""
    if isinstance(words, str | Mapping | None) or not all(isinstance(word, str) for word in words):
        raise ConfigError(f"overrides must be a list of strings: ['task=Move', 'seed=3'], not {words!r}")
    return [_quote_path(_YAML_NUMBER.sub(r"\1\2", word)) for word in words]


def _quote_path(word: str) -> str:
    key, _, text = word.partition("=")
    own = key.lstrip("+")
    is_file = own.startswith("task.") and own.endswith(".file")
    is_path = is_file or own in ("results_dir", "targets.source")
    # Quoted strings, null, interpolations, and multiple values of a sweep are unchanged.
    if not is_path or text == "null" or not text.strip() or re.search(r"[,'\"]|\$\{|^\w+\(", text):
        return word
    return f"{key}={quoted(text)}"


def quoted(text: str) -> str:
    """Return a quoted string that Hydra reads literally."""
    # Backslashes are literal, unless followed by a quote.
    escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + (r"\'" if found[2] else ""), text)
    return f"'{escaped}'"


def parse(words: Sequence[str]) -> list[Override]:
    """Parse overrides; raise ConfigError if one is invalid."""
    with explained():
        parsed = [_parsed(word) for word in words]
    return parsed


@functools.lru_cache(maxsize=1024)
def _parsed(word: str) -> Override:
    """Parse one override; cached, because jobs of a sweep share overrides."""
    (override,) = OverridesParser.create().parse_overrides([word])
    return override


def swept(override: Override, names: Iterable[str]) -> list[str]:
    """Return the values of an override, such as ``seed=0,1`` or ``task=glob(R*)``, as strings; globs select
    from ``names``. Raise ConfigError if there are no values."""
    value = override.value()
    if isinstance(value, IntervalSweep):
        raise ConfigError(f"'{override.input_line}': an interval is not a list of values: use range")
    if isinstance(value, Glob):
        found = value.filter(list(names))
        # glob(*) is the suite; glob(Hand*) selects extension tasks.
        found = [name for name in found if name not in EXTENSION_TASKS] or found
    elif override.is_sweep_override():
        try:
            found = list(override.sweep_string_iterator())
        except (ArithmeticError, ValueError) as error:
            raise ConfigError(f"'{override.input_line}': {error}") from None
    else:
        found = [override.get_value_element_as_str()]
    if not found:
        raise ConfigError(f"'{override.input_line}' has no values")
    return found


def variant_changes(task: DictConfig, name: str) -> DictConfig:
    """Return the changes of a variant, given a task with all its variants; raise ConfigError if the variant
    does not exist."""
    if name not in task.variants:
        names = [*task.variants, *([RANDOM] if task.random else [])]
        advice = suggest(name, names) if names else 'add variants: {"1": {}} to the task'
        raise ConfigError(f"variant {name} of task {task.name} does not exist; {advice}")
    changes = task.variants[name]
    if not isinstance(changes, DictConfig):
        expected = "a part of the task's structure, or {}"
        raise ConfigError(f"variant {name} of task {task.name} must be {expected}, not {changes}")
    return changes


# ---------------------------------------------------------------------------------------------- explanations


@contextmanager
def explained() -> Iterator[None]:
    """Convert errors of Hydra, OmegaConf and YAML inside the ``with`` block to ConfigError."""
    try:
        yield
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(_explain(error)) from None


def _explain(error: Exception) -> str:
    """Return a one-line message, without a full stop."""
    if launcher := re.search(r"Could not (?:load|find) 'hydra/launcher/(joblib|submitit)", str(error)):
        return f"this launcher is not installed: pip install 'plab[{launcher[1]}]'"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return f"{group} '{name}' does not exist; {suggest(name, error.options)}"
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return f"{mark.name}, line {mark.line + 1}: {error.problem}"
    if isinstance(error, OverrideParseException):
        return f"cannot read '{error.override}': write key=value, and quote values with special characters"
    cause = _omegaconf_cause(error)
    file = re.match(r"In '(.+)': \w+ raised", str(error))
    if file and cause is not None:
        return f"{file[1]}.yaml: {_explain(cause)}"
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return _unknown_key(cause)
    if isinstance(cause, MissingMandatoryValue):
        return f"{cause.full_key} is missing: set it"
    if cause is not None:
        text = (cause.msg or str(cause)).strip().splitlines()[0]
        text = re.sub(".* is not a ListConfig.*", "must be a list, such as [0.1]", text)
        return f"{cause.full_key}: {text}" if cause.full_key else text
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _omegaconf_cause(error: BaseException | None) -> OmegaConfBaseException | None:
    while error is not None and not isinstance(error, OmegaConfBaseException):
        # Hydra raises some errors while handling another, without setting the cause.
        error = error.__cause__ or error.__context__
    return error


def _unknown_key(error: OmegaConfBaseException) -> str:
    parent = error.parent_node
    key = str(error.full_key or error.key)
    last = key.rpartition(".")[2]
    names = [str(name) for name in parent if name != "hydra"] if isinstance(parent, DictConfig) else []
    if not names:
        above = key.rpartition(".")[0]
        return f"unknown key '{key}': {above} has none; if it refers to another key, override that one"
    # For lr=0.1 instead of method.lr=0.1, suggest the key with this ending.
    below = leaves(OmegaConf.to_container(parent)) if "." not in key else ()
    deeper = [path for path, _ in below if path.rpartition(".")[2] == last and not path.startswith("hydra.")]
    if deeper:
        return f"unknown key '{key}'; did you mean {' or '.join(deeper[:3])}? choose from: {', '.join(names)}"
    return f"unknown key '{key}'; {suggest(last, names)}"
