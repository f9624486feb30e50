"""Which rollout is meant: the same on every command line that shows one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from plab.arguments import positive, sources_and_words, to_write
from plab.checks import check_sources
from plab.config import load_config
from plab.render.graphics import RenderError
from plab.words import IDLE, require_effect

if TYPE_CHECKING:
    from plab.config_types import Config

__all__ = ["WITHOUT_EFFECT", "make_parser", "require_writable", "rollout", "settle"]

WITHOUT_EFFECT = ("method", "seed", "sim.memory_mb", *IDLE)
"""Keys of a configuration that change no picture."""


def make_parser(usage: str, every: str) -> argparse.ArgumentParser:
    """Return a parser with the arguments that choose a rollout; mistakes in them are RenderErrors.

    Args:
        usage: What ``--help`` says first.
        every: What has a frame every K environment steps.
    """
    parser = argparse.ArgumentParser(usage=usage, allow_abbrev=False)
    parser.add_argument(
        "what", nargs="*", metavar="RESULT_FILE | KEY=VALUE", help="keys are those of python -m plab.run"
    )
    parser.add_argument(
        "--every", type=positive, metavar="K", help=f"{every} has a frame every K environment steps"
    )
    parser.add_argument(
        "--config-dir", metavar="FOLDER", help="folder with tasks of your own, as for python -m plab.run"
    )

    def refuse(message: str) -> NoReturn:
        raise RenderError(message)

    parser.error = refuse  # type: ignore[method-assign]
    return parser


def settle(arguments: argparse.Namespace, ending: str) -> Path:
    """Find out which rollout is meant, as far as can be done without simulating.

    Adds ``result``, the result file or None, and ``config``, the configuration where there is none.

    Args:
        arguments: Those of the command line.
        ending: What is written instead of ``.h5``.

    Returns:
        What is to be written where nothing else is said: named like the result, and beside it (but not inside
        an archive), or like the task.

    Raises:
        RenderError: If nothing is chosen, or two things are.
        plab.config.ConfigError: If the configuration is wrong.
    """
    files, overrides = sources_and_words(arguments.what)
    require_effect(overrides, WITHOUT_EFFECT, "a picture")
    if len(files) > 1 or (files and overrides):
        raise RenderError(f"give one result file or overrides (KEY=VALUE), not '{' '.join(arguments.what)}'")
    if files:
        # Imported here: it loads pandas, for which no mistake above should have to wait.
        from plab.results.files import split_archive

        arguments.result = Path(files[0])
        folder = Path() if split_archive(arguments.result) else arguments.result.parent
        return folder / (arguments.result.stem + ending)
    if not overrides:
        raise RenderError("say what to show: a result file, or a task such as task=Torus; --help explains")
    arguments.result = None
    cfg = arguments.config = load_config(overrides, arguments.config_dir)
    check_sources(cfg)
    return Path(f"{cfg.task.name}-v{cfg.variant}{ending}")


def require_writable(path: Path) -> None:
    """Raise :class:`RenderError` if a file cannot be written, before anything is computed."""
    try:
        to_write(str(path))
    except argparse.ArgumentTypeError as error:
        raise RenderError(str(error)) from None


def rollout(arguments: argparse.Namespace) -> tuple[Config, np.ndarray]:
    """Return configuration and actions, shape [T, A], of the rollout that :func:`settle` found."""
    from plab.render import recording

    if arguments.result:
        return recording.result(arguments.result)
    return arguments.config, recording.demonstration(arguments.config)
