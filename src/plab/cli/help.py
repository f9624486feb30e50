"""Texts of ``plab run --help`` and ``--help-all``, generated from the YAML files."""

from __future__ import annotations

import textwrap

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
  --help-all        more examples, and the files of all choices with every key and its default
"""

_KEYS = """\
KEYS used often, with their defaults
  variant=1                 of the task; random is drawn by seed_scene
  seed=0                    random numbers of the method
  method.iterations=200     updates of the actions
  method.lr=0.1             step size
  sim.device=cpu            cpu or cuda
  sim.particles_scale=1.0   share of the particles, for quick tries
  results_dir=results       folder of the result files
  force=false               begin again, and replace what is there
  logger=none               tensorboard or wandb, too
"""

_WIDTH = 100


def help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help``, two screens: usage, flags, names of all choices, including the user's
    files in ``config_dir``, and frequent keys."""
    parts = [_USAGE, _FLAGS, "CHOICES"]
    for group in (*GROUPS, EXPERIMENT):
        start = f"  {'+' if group == EXPERIMENT else ''}{group}="
        names = ", ".join(choices(group, config_dir))
        parts += textwrap.wrap(names, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
    return "\n".join([*parts, "", _KEYS.rstrip()])


def full_help_text(config_dir: str | None = None) -> str:
    """Return the text of ``--help-all``: ``--help``, more examples, and the commented YAML file of each
    choice, which has every key with its default."""
    head = "FILES, whose keys are below the name of the group, such as method.lr"
    parts = [help_text(config_dir), _MORE_EXAMPLES, head]
    files = {"config": conf_folder() / "config.yaml"}
    for group in (*GROUPS, EXPERIMENT):
        sign = "+" if group == EXPERIMENT else ""
        files |= {f"{sign}{group}={name}": path for name, path in choices(group, config_dir).items()}
    for title, path in files.items():
        text = path.read_text(encoding="utf-8").removeprefix("# @package _global_\n").rstrip()
        parts.append(f"\n{title}\n{textwrap.indent(text, '  ')}")
    return "\n".join(parts)
