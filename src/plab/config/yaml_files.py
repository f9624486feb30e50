"""Files of the user's own in YAML, looked at before Hydra and OmegaConf do what they say."""

from __future__ import annotations

from pathlib import Path

import yaml

from plab.errors import ConfigError

__all__ = ["require_plain"]

MOST_BYTES = 1_000_000

MOST_VALUES = 100_000
"""Values in a file, at most, those that an alias repeats counted each time: OmegaConf copies them."""


def require_plain(path: Path) -> None:
    """Refuse a file that is no text, or whose aliases make it endless.

    What is no YAML is left to whoever reads it, who says where.

    Raises:
        ConfigError: If it is such a file.
    """
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise ConfigError(f"{path}: is larger than {MOST_BYTES} bytes: a file of the configuration is not")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"{path}: cannot be read as a text in UTF-8") from None
    try:
        # Not the loader in C, which deep nesting would crash.
        count = _count(yaml.compose(text, Loader=yaml.SafeLoader), {})
    except yaml.YAMLError:
        return
    except RecursionError:
        raise ConfigError(f"{path}: is nested too deeply, or has an alias that contains itself") from None
    if count > MOST_VALUES:
        raise ConfigError(
            f"{path}: has {count} values, aliases counted, of which {MOST_VALUES} do: write fewer"
        )


def _count(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Return how many values there are in a node, those behind an alias every time."""
    if node is None or isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        entries = [part for pair in node.value for part in (pair if isinstance(pair, tuple) else (pair,))]
        known[id(node)] = 1 + sum(_count(entry, known) for entry in entries)
    return known[id(node)]
