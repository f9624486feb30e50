"""The texts of ``--help`` and ``--help-all``, made from the YAML files, which they cannot disagree with."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from plab.config import EXPERIMENT, GROUPS, choices, conf_folder
from plab.config.families import schemas

__all__ = ["full_help_text", "help_text"]

_USAGE = """\
plab run [KEY=VALUE ...] [-m]

Runs one task, variant, method and seed of PlasticineLab; writes one result file into results_dir.
A run that was stopped goes on when the same command is given again; one that has finished is not
repeated.

EXAMPLES
  plab run task=Rope method=adam seed=0
  plab run task=Move variant=3 method=gd method.lr=50
  plab run sim.particles_scale=0.2 method.iterations=20      a quick try
  plab run -m variant=1,2,3,4,5 seed=0,1,2           fifteen runs that share a simulator
  plab run +experiment=yield_ablation                a sweep that a file describes
"""

_FLAGS = """\
FLAGS
  -m, --multirun    run every combination of the values given with commas
  --cfg job         print the configuration and stop; with --package sim, only that section
  --config-dir DIR  use the YAML files in DIR/task, DIR/method, DIR/sim and DIR/experiment, too
  -h, --help        this text; --hydra-help explains Hydra's own flags
  --help-all        more examples, what each choice is, and every key with its default
"""

_MORE_EXAMPLES = """\
MORE EXAMPLES
  plab run sim=reference sim.device=cuda             float64 on the GPU
  plab run 'task.variants.1.manipulators.pillar.position=[0.4,0,0.5]'
  plab run -m variant=random 'seed_scene=range(10)'  ten drawn configurations
  plab run task=Torus method=ppo method.profile=paper            reinforcement learning
  plab run --config-dir mine task=Dumbbell           the task of mine/task/Dumbbell.yaml
  plab run +experiment=smoke hydra/launcher=batch_joblib         in several processes
"""

_OFTEN = (
    "variant",
    "seed",
    "results_dir",
    "force",
    "progress",
    "logger",
    "method.iterations",
    "method.lr",
    "sim.device",
    "sim.particles_scale",
)
"""Keys that the short text explains."""

_WIDTH = 100
"""Columns of the short text."""

_SHORT, _LONG = 24, 52
"""Columns of a key and its default, in the short text and in the long one."""

_KEY = re.compile(r"^(?P<indent> *)(?P<key>[\w\"]+):(?P<value>[^#]*?)(?:\s*# (?P<comment>.*))?$")


def help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help``, two screens: usage, flags, the names of all choices, those of the user's
    own files in ``config_dir`` included, keys used often."""
    parts = [_USAGE, _FLAGS, "CHOICES"]
    for group in (*GROUPS, EXPERIMENT):
        sign = "+" if group == EXPERIMENT else ""
        start = f"  {sign}{group}="
        names = ", ".join(choices(group, config_dir))
        parts += textwrap.wrap(names, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
    parts += ["", "KEYS used often, with their defaults"]
    folder = conf_folder()
    files = {"": "config.yaml", "method.": "method/adam.yaml", "sim.": "sim/fast.yaml"}
    for prefix, name in files.items():
        for key, line in _keys(folder / name, prefix, _SHORT):
            if key in _OFTEN:
                parts += textwrap.wrap(line, _WIDTH, subsequent_indent=" " * (_SHORT + 3))
    return "\n".join(parts)


def full_help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help-all``: that of ``--help``, more examples, what each choice is, and every
    key with its default and explanation."""
    folder = conf_folder()
    parts = [_USAGE, _MORE_EXAMPLES, _FLAGS]
    for group in (*GROUPS, EXPERIMENT):
        sign = "+" if group == EXPERIMENT else ""
        names = choices(group, config_dir).items()
        parts.append(f"{group.upper()}S" if group != "sim" else "SIMULATOR PRESETS")
        parts += [f"  {sign}{group}={name:<10} {_title(path)}" for name, path in names]
        parts.append("")
    parts.append("KEYS, with their defaults")
    parts += _lines(folder / "config.yaml", "")
    for group, name in (("protocol", "plab"), ("sim", "fast"), ("method", "adam")):
        parts += _lines(folder / group / f"{name}.yaml", f"{group}.")
    # Each has keys of its own; those of adam are the default's, above.
    for method in (name for name, _ in schemas() if name in choices("method")):
        parts.append(f"  of method={method}; what has no value here takes the profile's:")
        parts += _lines(folder / "method" / f"{method}.yaml", "method.")
    for name, path in choices("method", config_dir).items():
        if name not in choices("method"):
            parts.append(f"  of method={name}:")
            parts += _lines(path, "method.")
    parts.append("  and those of the task; here of Rope:")
    parts += _lines(folder / "task" / "Rope.yaml", "task.")
    return "\n".join(parts)


def _title(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    # The first line of an experiment says where its keys go.
    return next(line for line in lines if not line.startswith("# @package")).lstrip("# ")


def _lines(path: Path, prefix: str) -> list[str]:
    return [line for _, line in _keys(path, prefix, _LONG)]


def _keys(path: Path, prefix: str, width: int) -> Iterator[tuple[str, str]]:
    """Yield each commented key of a YAML file, except Hydra's, and its line: default and explanation."""
    parents: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        match = _KEY.match(line)
        if match is None:
            continue
        depth = len(match["indent"]) // 2
        parents[depth:] = [match["key"]]
        if parents[0] in ("defaults", "hydra") or (len(parents) > 1 and parents[0] == "variants"):
            continue
        key = prefix + ".".join(parents)
        value = re.sub(r"^[&*]\w+|^\$\{.*", "", match["value"].strip())
        yield key, f"  {f'{key}={value}' if value else key:<{width}} {match['comment'] or ''}".rstrip()
