"""The command line of runs: ``python -m plab.run task=Rope method=adam seed=0``.

Hydra composes the configuration and sweeps over it; this module turns every mistake of a user into one line
and exit code 2, and hands a checked configuration to :func:`plab.runners.run_config`. Sweeps are carried out
by :class:`hydra_plugins.plab_launcher.BatchLauncher`.
"""

from __future__ import annotations

import math
import os
import re
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import hydra
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode, TaskFunction
from omegaconf import DictConfig

from plab.cli.arguments import name_flag
from plab.cli.command import EXIT_INTERRUPTED, EXIT_USER_ERROR, command_line, complain
from plab.cli.help import full_help_text, help_text
from plab.config import EXPERIMENT, ConfigError, check_overrides, conf_folder, finish
from plab.config.checks import check_device, check_packages, check_sources
from plab.config.errors import COMPOSE_ERRORS, explain
from plab.config.words import quote_folders, shortened, unusable
from plab.errors import PlabError
from plab.outcomes import Refusal, Tally
from plab.runners.simulator_cache import SimulatorCache
from plab.scenes import SceneError
from plab.targets import TargetError

__all__ = ["main"]

EXIT_BROKE_OFF = 1


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        Exit code: 0 if every result is there, 1 if a run broke off, 2 for a mistake of the user's, 130 after
        Ctrl-C.
    """
    tally = Tally()
    argv, arguments = _parse(list(sys.argv[1:] if argv is None else argv))
    if arguments.help or arguments.help_all:
        text = full_help_text if arguments.help_all else help_text
        print(text(arguments.config_dir))
        return 0
    try:
        with _hydra_raises(argv), _mode_by_flags(arguments):
            hydra.main(config_path=str(conf_folder()), config_name="config", version_base="1.3")(
                _job(tally, arguments.config_dir)
            )()
    except Refusal as refusal:
        return complain(str(refusal), refusal.code)
    except COMPOSE_ERRORS as error:
        if tally.started and isinstance(error, RecursionError):
            raise
        raise ConfigError(explain(error)) from error
    except (PlabError, OSError, MemoryError):
        raise
    except KeyboardInterrupt:
        tally.report()
        return complain("stopped: run the same command again to resume", EXIT_INTERRUPTED)
    except Exception as error:
        # Before the first job these are Hydra's: flags that exclude each other, settings that it cannot use.
        if tally.started:
            raise
        reason = unusable(error, arguments.overrides)
        if reason is None and not isinstance(error, ValueError):
            raise
        raise ConfigError(reason or str(error)) from error
    if tally.error is not None:
        raise tally.error
    return max(tally.code, tally.report())


def _job(tally: Tally, config_dir: str | None) -> TaskFunction:
    """Return what Hydra calls with the configuration of a single run, or of a job of another launcher."""

    # Launchers other than plab's may do one job after the other in this process.
    cache = SimulatorCache()

    def job(composed: DictConfig) -> float:
        tally.started = True
        try:
            return _run(composed, cache, config_dir)
        except Exception as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                # It has to get out of the job's process.
                raise
            # Not raised: Hydra would add lines of its own.
            if isinstance(error, Refusal):
                tally.code = complain(str(error), error.code)
            else:
                tally.error = error
            return math.nan

    # For the launcher, which has the outcomes of a sweep.
    job.tally = tally  # type: ignore[attr-defined]
    return job


def _run(composed: DictConfig, cache: SimulatorCache, config_dir: str | None) -> float:
    """Check one composed configuration and run it; raise :class:`Refusal` for what is no bug."""
    # Imported here: torch and taichi take seconds, which no mistake and no --help should wait for.
    try:
        _require_sweep(HydraConfig.get())
        cfg = finish(composed, HydraConfig.get().overrides.task)
        check_sources(cfg)
        check_device(cfg)
        check_packages(cfg)
        from plab.cli.next_steps import next_steps
        from plab.runners import run_config
        from plab.runners.jobs import USER_ERRORS, RunBusyError, RunError
    except (ConfigError, SceneError, TargetError) as error:
        raise Refusal(str(error), EXIT_USER_ERROR) from error
    try:
        score = run_config(cfg, cache)
    except (RunBusyError, RunError) as error:
        raise Refusal(str(error), EXIT_BROKE_OFF) from error
    except USER_ERRORS as error:
        raise Refusal(str(error), EXIT_USER_ERROR) from error
    if cfg.progress and HydraConfig.get().mode == RunMode.RUN:
        print(*next_steps(cfg, HydraConfig.get().overrides.task, config_dir), sep="\n")
    return score


def _require_sweep(settings: Any) -> None:
    """Refuse settings of sweeps, of which a single run takes no notice."""
    words = settings.overrides.hydra
    of_sweeps = [word for word in words if re.match(r"[+~]*hydra[./](launcher|sweep)", word)]
    if settings.mode == RunMode.RUN and of_sweeps:
        raise ConfigError(
            f"'{shortened(of_sweeps[0])}' has no effect on a single run: add -m, or leave it out"
        )


def _parse(argv: list[str]) -> tuple[list[str], Namespace]:
    """Check the arguments; return them in the order that Hydra reads, overrides before flags, and their
    meaning."""
    parser = get_args_parser()
    parser.add_argument("--help-all", action="store_true")

    def refuse(message: str) -> NoReturn:
        raise ConfigError(name_flag(parser, message))

    parser.error = refuse  # type: ignore[method-assign]
    arguments = parser.parse_intermixed_args(argv)
    if arguments.package and not arguments.cfg:
        raise ConfigError(
            "--package has no effect without --cfg: write --cfg job --package sim, or leave it out"
        )
    rest = list(argv)
    for override in arguments.overrides:
        rest.remove(override)
    arguments.overrides = quote_folders(arguments.overrides)
    try:
        asked = arguments.help or arguments.help_all
        check_overrides([] if asked else arguments.overrides, arguments.config_dir)
    except COMPOSE_ERRORS as error:
        raise ConfigError(explain(error)) from error
    return [*arguments.overrides, *rest], arguments


@contextmanager
def _mode_by_flags(arguments: Namespace) -> Iterator[None]:
    """Have Hydra go by ``-m`` alone where nothing else can say whether this is a sweep: it would compose the
    whole configuration for its key ``hydra.mode``, which takes a tenth of a second, and then again."""
    words = [word.lstrip("+~") for word in arguments.overrides]
    asks = any(re.match(rf"({EXPERIMENT}|hydra)[=@]|hydra\.mode", word) for word in words)
    if asks or arguments.config_name or arguments.config_path:
        yield
        return
    before = Hydra.get_mode
    Hydra.get_mode = lambda *_args, **_kwargs: None  # type: ignore[method-assign]
    try:
        yield
    finally:
        Hydra.get_mode = before  # type: ignore[method-assign]


@contextmanager
def _hydra_raises(argv: list[str]) -> Iterator[None]:
    """Give Hydra its arguments, and have it raise what goes wrong instead of printing it and exiting."""
    before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [sys.argv[0], *argv]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        sys.argv = before[0]
        if before[1] is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = before[1]
