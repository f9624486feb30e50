"""Identity of a run: its configuration as plain data, the hash of that, and the name of its file.

Light, as it is imported by readers of results, which do without Hydra.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plab.config.selection import lookup
from plab.scenes.bodies import MATERIAL_KEYS

SUFFIX = ".h5"
"""End of the names of result files."""

IDLE = ("results_dir", "force", "progress", "logger", "checkpoint_seconds")
"""Keys that only ``plab run`` uses."""

_NO_EFFECT = {
    "": IDLE,
    # Gradients are the same bits for any spacing of checkpoints.
    "sim": ("memory_mb",),
    # Name and score change no number, and the contact term is that of the method.
    "protocol": ("name", "score", "contact"),
    "task": ("release",),
}
"""Configuration keys by section that cannot change a result, hence are left out of the hash."""


def config_dict(cfg: Any) -> dict[str, Any]:
    """Return a :class:`plab.config.Config`, or a mapping, as plain dictionaries and lists.

    Optional keys of bodies that have no value, such as ``file``, are left out.
    """
    plain = json.loads(json.dumps(dict(cfg) if isinstance(cfg, Mapping) else dataclasses.asdict(cfg)))
    bodies = lookup(plain, "task.bodies")
    for body in bodies.values() if isinstance(bodies, dict) else ():
        for key in ("file", "sha256", *MATERIAL_KEYS):
            if isinstance(body, dict) and body.get(key, "") is None:
                del body[key]
    return plain


def config_hash(cfg: Any) -> str:
    """Return the SHA-256, in hex, of everything in a configuration that can change a result."""
    plain = config_dict(cfg)
    for section, keys in _NO_EFFECT.items():
        part = plain[section] if section else plain
        for key in keys:
            part.pop(key, None)
    _drop_places(plain["task"])
    if isinstance(lookup(plain, "targets.source"), str):
        # The target comes from a file, whatever the task's recipe is.
        for task in (plain["task"], *plain["task"].get("variants", {}).values()):
            task.pop("target", None)
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _drop_places(node: Any) -> None:
    """Remove the paths of files from a part of a configuration: their SHA-256 is what counts."""
    for key, value in list(node.items()) if isinstance(node, dict) else ():
        if key == "file" and not isinstance(value, dict):
            del node[key]
        _drop_places(value)


def member_name(config: Mapping[str, Any], digest: str) -> Path:
    """Return a run's place inside a results folder or an archive, by its configuration and its hash."""
    folder = Path(f"{config['task']['name']}-v{config['variant']}") / config["method"]["name"]
    return folder / f"seed{config['seed']}-{digest[:8]}{SUFFIX}"
