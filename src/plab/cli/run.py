"""The command ``plab run``, which executes one configuration or a sweep, and its help texts."""

from __future__ import annotations

import re
import shlex
import sys
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from plab.cli.command import Parser, close_output, command_line, prompt_interrupts
from plab.config import EXPERIMENT, GROUPS, ConfigError, choices, load_config, plab_folder
from plab.config.compose import check_overrides, check_sources, compose_with_hydra, require_runnable
from plab.config.overrides import parse, prepared


@command_line
def main(argv: Sequence[str]) -> int:
    """Run one configuration, or a sweep.

    Returns:
        Exit code: 0 if all results exist, 1 if a run failed, 2 for invalid input.
    """
    options = parser().parse_intermixed_args(argv)
    words, config_dir = prepared(options.overrides), options.config_dir
    if options.help or options.help_all:
        check_overrides([], config_dir)
        print(help_text(config_dir, full=options.help_all))
        return 0
    check_overrides(words, config_dir)
    if options.cfg:
        config = compose_with_hydra(words, config_dir)
        shown = {name: config[name] for name in config if (name == "hydra") == (options.cfg == "hydra")}
        whole: Any = OmegaConf.create(shown, flags={"allow_objects": True})
        whole = OmegaConf.select(whole, options.package) if options.package else whole
        if whole is None:
            raise ConfigError(f"--package {options.package} is empty or does not exist")
        print(OmegaConf.to_yaml(whole).rstrip() if OmegaConf.is_config(whole) else whole)
        return 0
    try:
        if (master := _sweep_settings(options, words)) is not None:
            # Imported here and below, because torch and Taichi take seconds to load.
            with prompt_interrupts():
                from plab.sweep.execution import sweep

            return sweep(words, master, config_dir)
        cfg = load_config(words, config_dir, alone=True)
        check_sources(cfg)
        require_runnable(cfg)
        with prompt_interrupts():
            from plab.runners import run_config

        try:
            run_config(cfg)
            if cfg.progress:
                own = [] if config_dir is None else ["--config-dir", config_dir]
                result, folder = shlex.join([str(cfg.path), *own]), shlex.quote(cfg.results_dir)
                print(f"a picture: plab render {result}; a page of all runs: plab report html {folder}")
            sys.stdout.flush()
        except BrokenPipeError:
            # The exit code is that of the run if only its last lines could not be printed.
            if cfg.force or not cfg.path.exists():
                raise
            close_output()
    except KeyboardInterrupt:
        raise KeyboardInterrupt("run the same command again to resume") from None
    return 0


def _sweep_settings(options: Namespace, words: Sequence[str]) -> DictConfig | None:
    """Return a configuration with Hydra's sweep settings, or None for a single run."""
    by_key = [(one.key_or_group, one) for one in parse(words)]
    own = [one for key, one in by_key if key == EXPERIMENT or one.is_hydra_override()]
    if not own and not options.multirun:
        return None
    # Folders for launcher logs; other keys may belong to a method or task other than the default.
    own += [one for key, one in by_key if key == "results_dir" and not one.is_sweep_override()]
    master = compose_with_hydra([str(one.input_line) for one in own], options.config_dir)
    if master.hydra.job.chdir:
        raise ConfigError("hydra.job.chdir=true would move results_dir: omit it")
    mode, values = str(master.hydra.mode), master.hydra.sweeper.params
    # An experiment with values is a sweep, unless hydra.mode says otherwise.
    if options.multirun or mode.endswith("MULTIRUN") or (mode == "None" and values):
        return master
    if idle := [word for word in words if re.match(r"[+]*hydra[./](launcher|sweep)", word)]:
        raise ConfigError(f"'{idle[0]}' has no effect on a single run: add -m, or omit it")
    return None


def parser() -> Parser:
    """Return the parser of the arguments."""
    made = Parser("plab run", "", add_help=False)
    add = made.add_argument
    add("overrides", nargs="*")
    add("-h", "--help", action="store_true")
    add("--help-all", action="store_true")
    add("-m", "--multirun", action="store_true")
    add("--cfg", choices=("job", "hydra"))
    add("--package")
    add("--config-dir")
    return made


# ------------------------------------------------------------------------------------------------------- help

_HELP = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8")


def help_text(config_dir: str | None = None, *, full: bool = False) -> str:
    """Return the two-screen text of ``--help``: usage, flags, names of all choices, including the user's
    files in ``config_dir``, and frequent keys. The ``full`` text of ``--help-all`` has more examples, and the
    commented YAML file of each choice, with every key and its default."""
    names, yaml = [], {"config": plab_folder() / "config.yaml"}
    for group in (*GROUPS, EXPERIMENT):
        start, found = f"{'+' if group == EXPERIMENT else ''}{group}=", choices(group, config_dir)
        indent = " " * (2 + len(start))
        names += textwrap.wrap(", ".join(found), 100, initial_indent=f"  {start}", subsequent_indent=indent)
        yaml |= {f"{start}{name}": path for name, path in found.items()}
    shown, title, more = _HELP.partition("MORE EXAMPLES\n")
    shown = shown.replace("{choices}", "\n".join(names)).rstrip()
    if not full:
        return shown
    head = "FILES; their keys are below the name of the group, such as method.lr"
    parts = [f"{shown}\n{title}{more}", head]
    for name, path in yaml.items():
        text = path.read_text(encoding="utf-8").removeprefix("# @package _global_\n").rstrip()
        parts.append(f"\n{name}\n{textwrap.indent(text, '  ')}")
    return "\n".join(parts)
