"""Tasks and variants of the suite, located without importing Hydra, torch or Taichi."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SUITE_VARIANTS = ("1", "2", "3", "4", "5")
"""Variants of every task of the suite."""

EXTENSION_TASKS = (
    *("Gripper", "HandFold", "HandLift", "HandPinch", "HandPress", "HandRoll"),
    *("Pour", "SandHeap"),
)
"""Extension tasks (articulated models, sand, fluid), excluded from the suite's tables and defaults."""

PAPER_METHODS = ("sac", "td3", "ppo", "adam", "gd", "adam_h")
"""Methods compared in the paper, in its order."""

PAPER_SEEDS = ("0", "1", "2")
"""Seeds per configuration in the paper."""


def plab_folder(name: str = "conf") -> Path:
    """Return a folder of plab's own files: ``plab/<name>`` of a wheel, or ``<name>`` of the source tree."""
    package = Path(__file__).resolve().parents[1]
    installed = package / name
    return installed if installed.is_dir() else package.parents[1] / name


def choices(group: str, config_dir: str | Path | None = None) -> dict[str, Path]:
    """Return the files of a group, such as ``task``, by name, sorted: plab's own files and the user's."""
    folders = [plab_folder(), *([] if config_dir is None else [Path(config_dir).expanduser()])]
    files = [path for folder in folders for path in (folder / group).glob("*.yaml")]
    return {path.stem: path for path in sorted(files, key=lambda path: path.stem)}


@functools.cache
def shipped_file(group: str, name: str) -> Mapping[str, Any]:
    """Return the content of one of plab's own files merged over its bases; empty if it does not exist."""
    # Imported here, because most commands do without it.
    from omegaconf import OmegaConf

    path = plab_folder() / group / f"{name}.yaml"
    if not path.is_file():
        return {}
    own: Any = OmegaConf.load(path)
    # Bases of other groups and of sections, such as cem@stages.search, are not files of this group.
    bases = [shipped_file(group, base) for base in own.get("defaults", ()) if isinstance(base, str)]
    merged: Any = OmegaConf.to_container(OmegaConf.merge(*bases, own))
    return merged


def suite_tasks() -> list[str]:
    """Return the names of the suite's tasks: the files in ``conf/task`` except extension tasks."""
    return [name for name in choices("task") if name not in EXTENSION_TASKS]
