"""The command ``plab run``: one configuration composed, checked and run, or a sweep over several."""

from __future__ import annotations

import re
import shlex
from argparse import Namespace
from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from plab.cli.command import Parser, command_line
from plab.config import ConfigError, load_config
from plab.config.compose import (
    EXPERIMENT,
    check_overrides,
    check_sources,
    compose_with_hydra,
    require_runnable,
)
from plab.config.overrides import parse, prepared

_OF_SWEEPS = re.compile(r"[+]*hydra[./](launcher|sweep)")


@command_line
def main(argv: Sequence[str]) -> int:
    """Run one configuration, or a sweep.

    Returns:
        Exit code: 0 if all results exist, 1 if a run failed, 2 for invalid input.
    """
    options = parser().parse_intermixed_args(argv)
    words, config_dir = prepared(options.overrides), options.config_dir
    if options.help or options.help_all:
        from plab.cli.help import full_help_text, help_text

        check_overrides([], config_dir)
        print((full_help_text if options.help_all else help_text)(config_dir))
        return 0
    check_overrides(words, config_dir)
    if options.cfg:
        _print_configuration(options, words)
        return 0
    try:
        if (master := _sweep_settings(options, words)) is not None:
            # Imported here, as below, because torch and Taichi take seconds to load.
            from plab.sweep.running import sweep

            return sweep(words, master, config_dir)
        cfg = load_config(words, config_dir, alone=True)
        check_sources(cfg)
        require_runnable(cfg)
        from plab.runners import run_config

        run_config(cfg)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("run the same command again to resume") from None
    if cfg.progress:
        result, folder = shlex.quote(str(cfg.path)), shlex.quote(cfg.results_dir)
        print(f"a picture: plab render {result}; a page of all runs: plab report html {folder}")
    return 0


def _sweep_settings(options: Namespace, words: Sequence[str]) -> DictConfig | None:
    """Return a configuration with Hydra's settings for a sweep, or None for a single run."""
    by_key = [(one.key_or_group, one) for one in parse(words)]
    own = [one for key, one in by_key if key == EXPERIMENT or one.is_hydra_override()]
    if not own and not options.multirun:
        return None
    # Folders for the logs of launchers; other keys may belong to another method or task than the default.
    own += [one for key, one in by_key if key == "results_dir" and not one.is_sweep_override()]
    master = compose_with_hydra([str(one.input_line) for one in own], options.config_dir)
    if options.multirun or str(master.hydra.mode).endswith("MULTIRUN"):
        return master
    if idle := [word for word in words if _OF_SWEEPS.match(word)]:
        raise ConfigError(f"'{idle[0]}' has no effect on a single run: add -m, or leave it out")
    return None


def _print_configuration(options: Namespace, words: Sequence[str]) -> None:
    config = compose_with_hydra(words, options.config_dir)
    shown = {name: config[name] for name in config if (name == "hydra") == (options.cfg == "hydra")}
    whole = OmegaConf.create(shown, flags={"allow_objects": True})
    print(OmegaConf.to_yaml(OmegaConf.select(whole, options.package) if options.package else whole).rstrip())


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
