"""The text of ``--help``, made from the YAML files, so that it cannot disagree with them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from plab.config import EXPERIMENT, GROUPS, choices, conf_folder
from plab.families import schemas

__all__ = ["help_text"]

_USAGE = """\
python -m plab.run [KEY=VALUE ...] [-m]

Runs one task, variant, method and seed of PlasticineLab and writes one result file into results_dir.
A run that was stopped goes on when the same command is given again; one that has finished is not repeated.

EXAMPLES
  python -m plab.run task=Rope method=adam seed=0
  python -m plab.run task=Move variant=3 method=gd method.lr=0.05
  python -m plab.run sim=reference sim.device=cuda             float64 on the GPU
  python -m plab.run sim.particles_scale=0.2 method.iterations=20         a quick try
  python -m plab.run -m variant=1,2,3,4,5 seed=0,1,2           fifteen runs that share a simulator

  python -m plab.run 'task.variants.1.manipulators.pillar.position=[0.4,0,0.5]'
  python -m plab.run -m variant=random 'seed_scene=range(10)'  ten drawn configurations
  python -m plab.run task=Torus method=ppo method.profile=paper            reinforcement learning
  python -m plab.run +experiment=yield_ablation                a sweep that a file describes
  python -m plab.run --config-dir mine task=Dumbbell           the task of mine/task/Dumbbell.yaml

  python -m plab.run +experiment=smoke hydra/launcher=batch_joblib         in several processes

FLAGS
  -m, --multirun    run every combination of the values given with commas
  --cfg job         print the configuration and stop; with --package sim, only that section
  --config-dir DIR  use the YAML files in DIR/task, DIR/method, DIR/sim and DIR/experiment, too
  -h, --help        this text; --hydra-help explains Hydra's own flags
"""

_KEY = re.compile(r"^(?P<indent> *)(?P<key>[\w\"]+):(?P<value>[^#]*?)(?:\s*# (?P<comment>.*))?$")


def help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help``: usage, choices, and every key with its default and explanation.

    Args:
        config_dir: Folder with files of the user's own, whose names are listed, too.
    """
    folder = conf_folder()
    parts = [_USAGE]
    for group in GROUPS:
        parts.append(f"{group.upper()}S" if group != "sim" else "SIMULATOR PRESETS")
        parts += [f"  {group}={name:<10} {_title(path)}" for name, path in choices(group, config_dir).items()]
        parts.append("")
    parts.append("EXPERIMENTS")
    names = choices(EXPERIMENT, config_dir).items()
    parts += [f"  +{EXPERIMENT}={name:<10} {_title(path)}" for name, path in names]
    parts += ["", "KEYS, with their defaults"]
    parts += _keys(folder / "config.yaml", "")
    parts += _keys(folder / "protocol" / "plab.yaml", "protocol.")
    parts += _keys(folder / "sim" / "fast.yaml", "sim.")
    parts += _keys(folder / "method" / "adam.yaml", "method.")
    # Each has keys of its own; those of adam are the default's, above.
    for method in (name for name, _ in schemas() if name in choices("method")):
        parts.append(f"  of method={method}; what has no value here takes the profile's:")
        parts += _keys(folder / "method" / f"{method}.yaml", "method.")
    for name, path in choices("method", config_dir).items():
        if name not in choices("method"):
            parts.append(f"  of method={name}:")
            parts += _keys(path, "method.")
    parts.append("  and those of the task; here of Rope:")
    parts += _keys(folder / "task" / "Rope.yaml", "task.")
    return "\n".join(parts)


def _title(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    # The first line of an experiment says where its keys go.
    return next(line for line in lines if not line.startswith("# @package")).lstrip("# ")


def _keys(path: Path, prefix: str) -> Iterator[str]:
    """Yield a line for each commented key of a YAML file, except Hydra's."""
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
        yield f"  {f'{key}={value}' if value else key:<52} {match['comment'] or ''}".rstrip()
