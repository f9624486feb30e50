"""The command line of runs: ``python -m plab.run task=Rope method=adam seed=0``.

Hydra composes the configuration and sweeps over it; this module turns every mistake of a user into one line
and exit code 2, and hands a checked configuration to :func:`plab.runners.run_config`.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from plab.cli_help import help_text
from plab.config import Config, ConfigError, build_scene, check_overrides, conf_folder, finish
from plab.config_errors import COMPOSE_ERRORS, explain, pick
from plab.scene import SceneError
from plab.targets import TargetError, check_target, load_release_target

__all__ = ["cuda_is_usable", "main"]

EXIT_BROKE_OFF = 1
EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

_CONFIG_ERRORS = (ConfigError, SceneError, TargetError)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments after the program's name; those of the process by default.

    Returns:
        Exit code: 0, 1 if a run broke off, 2 for a mistake of the user's, 130 after Ctrl-C.
    """
    started = False
    code = 0

    def job(composed: DictConfig) -> float:
        nonlocal started, code
        started = True
        try:
            return _run(composed)
        except _Refused as refusal:
            # Not raised: Hydra would add lines of its own, and the other jobs of a sweep go on.
            code = max(code, _complain(str(refusal), refusal.code))
            return math.nan

    try:
        argv, arguments = _parse(list(sys.argv[1:] if argv is None else argv))
        if arguments.help:
            print(help_text(arguments.config_dir))
            return 0
        with _hydra_raises(argv):
            hydra.main(config_path=str(conf_folder()), config_name="config", version_base="1.3")(job)()
    except COMPOSE_ERRORS as error:
        return _complain(explain(error), EXIT_USER_ERROR)
    except ConfigError as error:
        return _complain(str(error), EXIT_USER_ERROR)
    except (OSError, ValueError) as error:
        # Before the first job these are Hydra's: flags that exclude each other, a sweep's folder that cannot
        # be made.
        if started:
            raise
        writing = isinstance(error, OSError) and error.filename is not None
        reason = f"cannot write {error.filename}: {error.strerror}" if writing else str(error)
        return _complain(reason, EXIT_USER_ERROR)
    except KeyboardInterrupt:
        return _complain("stopped: run the same command again to resume", EXIT_INTERRUPTED)
    except SystemExit as stop:
        # Hydra leaves this way after --version and the like.
        return stop.code if isinstance(stop.code, int) else 0
    return code


class _Refused(Exception):
    """A run that cannot be done, for a reason that one line explains."""

    def __init__(self, reason: Exception, code: int) -> None:
        super().__init__(str(reason))
        self.code = code


def _run(composed: DictConfig) -> float:
    """Check one composed configuration and run it; raise :class:`_Refused` for what is no bug."""
    try:
        cfg = finish(composed, HydraConfig.get().overrides.task)
        _check_target(cfg)
        _check_device(cfg)
    except _CONFIG_ERRORS as error:
        raise _Refused(error, EXIT_USER_ERROR) from error
    # Imported here: torch and taichi take seconds, which no mistake and no --help should have to wait for.
    from plab.results import ResultsError
    from plab.runners import RunError, run_config

    try:
        return run_config(cfg)
    except (*_CONFIG_ERRORS, ResultsError) as error:
        raise _Refused(error, EXIT_USER_ERROR) from error
    except RunError as error:
        raise _Refused(error, EXIT_BROKE_OFF) from error


def _parse(argv: list[str]) -> tuple[list[str], Namespace]:
    """Check the arguments and put them into the order that Hydra reads: overrides, then flags.

    Returns:
        The arguments in this order, and what they mean.

    Raises:
        ConfigError: If a flag does not exist, an override makes no sense or the folder of ``--config-dir``
            does not do.
        hydra.errors.HydraException: If an override cannot be parsed.
    """
    parser = get_args_parser()
    flags = [flag for action in parser._actions for flag in action.option_strings if flag.startswith("--")]

    def refuse(message: str) -> NoReturn:
        unknown = message.partition("unrecognized arguments: ")[2]
        raise ConfigError(f"unknown flag {unknown}; {pick(unknown, flags)}" if unknown else message)

    parser.error = refuse
    arguments = parser.parse_intermixed_args(argv)
    check_overrides([] if arguments.help else arguments.overrides, arguments.config_dir)
    rest = list(argv)
    for override in arguments.overrides:
        rest.remove(override)
    return [*arguments.overrides, *rest], arguments


def _check_target(cfg: Config) -> None:
    """Find mistakes in what the target comes from before anything is compiled."""
    scene, source = build_scene(cfg), cfg.targets.source
    if source is None:
        check_target(scene, cfg.task.target)
    else:
        load_release_target(source, scene, cfg.variant)


def _check_device(cfg: Config) -> None:
    if cfg.sim.device == "cuda" and not cuda_is_usable():
        raise ConfigError("sim.device=cuda: this computer has no usable CUDA device; choose sim.device=cpu")


def cuda_is_usable() -> bool:
    """Return whether there is a CUDA device, by asking the driver: there is no library to import."""
    count = ctypes.c_int(0)
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    answered = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    return answered and count.value > 0


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


def _complain(message: str, code: int) -> int:
    print(f"plab: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
