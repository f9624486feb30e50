"""What to do after a run: the two lines at its end."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from plab.config import Config, ConfigError, load_config
from plab.config.words import IDLE, parse
from plab.results import result_path, row_count

__all__ = ["next_steps"]

_SIZES = ("particles_scale", "grid_size", "substeps", "horizon")
"""Keys of ``sim`` by which a run is made shorter or coarser."""

_QUICK = re.compile(rf"sim\.({'|'.join(_SIZES)}|dt)|method\.(stages\.\w+\.)?(iterations|episodes)")


def next_steps(cfg: Config, words: Sequence[str], config_dir: str | None = None) -> tuple[str, str]:
    """Return two lines that say what to do with the result of a run, composed of overrides, ``words``."""
    picture = f"python -m plab.render {shlex.quote(str(result_path(cfg)))}"
    page = f"python -m plab.report html --results {shlex.quote(cfg.results_dir)}"
    if (full := _full_words(cfg, words, config_dir)) is None:
        return f"a picture: {picture}", f"a page with curves and tables: {page}"
    if cfg.results_dir != "results":
        full.append(f"results_dir={cfg.results_dir}")
    if config_dir is not None:
        full += ["--config-dir", config_dir]
    command = shlex.join(full)
    return (
        f"a picture: {picture}; a page with curves and tables: {page}",
        "this was a quick run, which does not compare with others; the full one: "
        + f"python -m plab.run {command}".rstrip(),
    )


def _full_words(cfg: Config, words: Sequence[str], config_dir: str | None) -> list[str] | None:
    """Return the overrides of the run that this one is a shorter or coarser form of, None if it is none."""
    by_key = [(override.key_or_group, word) for word, override in zip(words, parse(words), strict=True)]
    if not any(_QUICK.fullmatch(key) for key, _ in by_key):
        return None
    kept = [word for key, word in by_key if not _QUICK.fullmatch(key) and key not in IDLE]
    try:
        full = _amounts(load_config(kept, config_dir))
    except ConfigError:
        # What is left does not go together.
        return None
    return kept if any(own < whole for own, whole in zip(_amounts(cfg), full, strict=True)) else None


def _amounts(cfg: Config) -> list[float]:
    """Return how much a run simulates in each respect."""
    method: dict[str, Any] = asdict(cfg.method)
    done = row_count(method) or method.get("episodes") or 0
    return [done, *(getattr(cfg.sim, name) for name in _SIZES)]
