"""Texts of ``plab run --help`` and ``--help-all``, generated from the YAML files."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from plab.config import EXPERIMENT, GROUPS, choices, conf_folder

_USAGE = """\
plab run [KEY=VALUE ...] [-m]

Runs one task, variant, method and seed of PlasticineLab; writes one result file into results_dir.
A run that was stopped goes on when the same command is given again; one that has finished is not
repeated.

EXAMPLES
  plab run task=Rope method=adam seed=0
  plab run task=Move variant=3 method=gd method.lr=50
  plab run sim.particles_scale=0.2 method.iterations=20        a quick try
  plab run -m variant=1,2,3,4,5 seed=0,1,2                     fifteen runs that share a simulator
  plab run -m task=Move method=sac,ppo method.episodes=2000    two methods that have the same key
  plab run +experiment=yield_ablation                          a sweep that a file describes
"""

_MORE_EXAMPLES = """\
MORE EXAMPLES
  plab run sim=reference sim.device=cuda                       float64 on the GPU
  plab run 'task.variants.1.manipulators.pillar.position=[0.4,0,0.5]'
  plab run -m variant=random 'seed_scene=range(10)'            ten drawn configurations
  plab run task=Torus method=ppo method.profile=paper          reinforcement learning
  plab run --config-dir mine task=Dumbbell                     the task of mine/task/Dumbbell.yaml
  plab run +experiment=smoke hydra/launcher=batch_joblib       in several processes
"""

_FLAGS = """\
FLAGS
  -m, --multirun    run every combination of the values given with commas
  --cfg job         print the configuration and stop; with --package sim, only that section
  --config-dir DIR  use the YAML files in DIR/task, DIR/method, DIR/sim and DIR/experiment, too
  -h, --help        this text
  --help-all        more examples, what each choice is, and every key with its default
"""

_COMMON_KEYS = {
    "config.yaml": ("variant", "seed", "results_dir", "force", "progress", "logger"),
    "method/adam.yaml": ("method.iterations", "method.lr"),
    "sim/fast.yaml": ("sim.device", "sim.particles_scale"),
}
"""Keys explained in the short text, by file."""

_WIDTH, _SHORT, _LONG = 100, 24, 52
"""Column widths of the short text, and of keys and defaults in both texts."""

_KEY = re.compile(r"^(?P<indent> *)(?P<key>[\w\"]+):(?P<value>[^#]*?)(?:\s*# (?P<comment>.*))?$")


def help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help``, two screens: usage, flags, the names of all choices, those of the user's
    own files in ``config_dir`` included, keys used often."""
    parts = [_USAGE, _FLAGS, "CHOICES"]
    for group in (*GROUPS, EXPERIMENT):
        start = f"  {'+' if group == EXPERIMENT else ''}{group}="
        names = ", ".join(choices(group, config_dir))
        parts += textwrap.wrap(names, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
    parts += ["", "KEYS used often, with their defaults"]
    for name, keys in _COMMON_KEYS.items():
        for key, line in _keys(conf_folder() / name, _SHORT):
            if key in keys:
                parts += textwrap.wrap(line, _WIDTH, subsequent_indent=" " * (_SHORT + 3))
    return "\n".join(parts)


def full_help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help-all``: ``--help``, more examples, a description of each choice, and every
    key with default and explanation."""
    parts = [_USAGE, _MORE_EXAMPLES, _FLAGS]
    keys = ["KEYS, with their defaults:", *(line for _, line in _keys(conf_folder() / "config.yaml", _LONG))]
    for group in (*GROUPS, EXPERIMENT):
        sign = "+" if group == EXPERIMENT else ""
        parts.append("SIMULATOR PRESETS" if group == "sim" else f"{group.upper()}S")
        for name, path in choices(group, config_dir).items():
            # The first line of an experiment is Hydra's package directive.
            lines = path.read_text(encoding="utf-8").removeprefix("# @package _global_\n").splitlines()
            parts.append(f"  {sign}{group}={name:<10} {lines[0].lstrip('# ')}")
            if group == "method" or name in ("plab", "fast", "Rope"):
                keys += [f"  of {group}={name}:", *(line for _, line in _keys(path, _LONG))]
        parts.append("")
    return "\n".join([*parts, *keys])


def _keys(path: Path, width: int) -> Iterator[tuple[str, str]]:
    """Yield each commented key of a YAML file, except Hydra's, and its line: default and explanation."""
    prefix = f"{path.parent.name}." if path.parent.name in GROUPS else ""
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
        value = re.sub(r"^[&*]\w+|.*\$\{.*", "", match["value"].strip())
        yield key, f"  {f'{key}={value}' if value else key:<{width}} {match['comment'] or ''}".rstrip()
