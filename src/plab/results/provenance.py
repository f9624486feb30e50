"""Provenance of a result: versions, platform, commit, device, start time."""

from __future__ import annotations

import functools
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = {
    "plab": "plab",
    "taichi": "taichi",
    "torch": "torch",
    "numpy": "numpy",
    "gymnasium": "gymnasium",
    "stable_baselines3": "stable-baselines3",
    "h5py": "h5py",
    "hydra": "hydra-core",
}
"""Recorded name to distribution name. The packages are not imported: torch alone takes seconds."""


def provenance(config: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the run that starts now.

    Args:
        config: Resolved configuration; gives device, precision and seed.

    Returns:
        Flat scalars, fit for HDF5 attributes. ``git_commit`` is empty where plab does not run from its
        repository.
    """
    commit, dirty = _git()
    return {
        **{name: _version(distribution) for name, distribution in _PACKAGES.items()},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
        "cpu_count": os.cpu_count() or 0,
        "git_commit": commit,
        "git_dirty": dirty,
        "device": config["sim"]["device"],
        "precision": config["sim"]["precision"],
        "seed": config["seed"],
        "start_time": now(),
        "resumed": 0,
    }


def now() -> str:
    """Return the time as results state it: UTC, ISO 8601, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def version_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return what differs between two provenances and could change numbers, as ``name old -> new``."""
    names = (*_PACKAGES, "python", "git_commit")
    return [f"{n} {before.get(n)} -> {now[n]}" for n in names if before.get(n) != now[n]]


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    """Return the CPU's model name on Linux, else what the platform module knows."""
    try:
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1].strip() if found else platform.processor()


@functools.cache
def _git() -> tuple[str, bool]:
    """Return the commit of plab's own repository ("" outside one), and whether tracked files differ.

    Of the first run of a process, and so of the code that runs in it.
    """
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed plab may lie inside somebody else's repository, whose commit says nothing about it.
        git("ls-files", "--error-unmatch", here.name)
        return git("rev-parse", "HEAD"), bool(git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return "", False
