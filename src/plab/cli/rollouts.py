"""Which rollout is meant: the same on every command line that shows one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plab.cli.arguments import Parser, positive, sources_and_words, to_write
from plab.config import load_config
from plab.config.checks import check_sources
from plab.config.selection import one_protocol, select
from plab.config.words import IDLE, require_effect
from plab.render.graphics import RenderError
from plab.results.examples import EXAMPLES, resolve

if TYPE_CHECKING:
    from plab.config import Config

__all__ = ["WITHOUT_EFFECT", "make_parser", "require_writable", "rollout", "settle"]

WITHOUT_EFFECT = ("method", "seed", "sim.memory_mb", *IDLE)
"""Keys of a configuration that change no picture."""


def make_parser(name: str, text: str, every: str) -> Parser:
    """Return a parser with the arguments that choose a rollout, of which ``every`` says what has a frame
    every K environment steps."""
    parser = Parser(name, text)
    add = parser.add_argument
    add("what", nargs="*", metavar="RESULTS | KEY=VALUE", help="keys are those of python -m plab.run")
    add("--every", type=positive, metavar="K", help=f"{every} has a frame every K environment steps")
    what = "folder with tasks of your own, as for python -m plab.run"
    add("--config-dir", metavar="FOLDER", help=what)
    return parser


def settle(arguments: argparse.Namespace, ending: str) -> None:
    """Find out which rollout is meant, as far as can be done without simulating.

    Adds ``result``, the result file or None, and ``config``, the configuration where there is none; and
    ``output`` where it was not given: named like the result, with ``ending`` for ``.h5``, and beside it (but
    not inside an archive), or like the task.

    Raises:
        RenderError: If nothing is chosen, or two things are.
        plab.config.ConfigError: If the configuration is wrong.
    """
    usual = _usual_output(arguments, ending)
    arguments.output = arguments.output or usual


def _usual_output(arguments: argparse.Namespace, ending: str) -> Path:
    files, overrides = sources_and_words(arguments.what)
    if files and all(map(_holds_many, files)):
        arguments.result, name = _best(files, overrides)
        return Path(f"{name}{ending}")
    require_effect(overrides, WITHOUT_EFFECT, "a picture")
    if len(files) > 1 or (files and overrides):
        raise RenderError(f"give one result file or overrides (KEY=VALUE), not '{' '.join(arguments.what)}'")
    if files:
        # Imported here: it loads pandas, for which no mistake above should have to wait.
        from plab.results.run_file import split_archive

        arguments.result = Path(files[0])
        folder = Path() if split_archive(arguments.result) else arguments.result.parent
        return folder / (arguments.result.stem + ending)
    if not overrides:
        raise RenderError("say what to show: a result file, or a task such as task=Torus; --help explains")
    arguments.result = None
    cfg = arguments.config = load_config(overrides, arguments.config_dir)
    check_sources(cfg)
    return Path(f"{cfg.task.name}-v{cfg.variant}{ending}")


def _holds_many(source: str) -> bool:
    """Return whether a word stands for a folder or an archive of results."""
    # Imported here, as below: it loads pandas, for which no mistake should have to wait.
    from plab.results.schema import ARCHIVE_SUFFIX

    return source in EXAMPLES or source.endswith(ARCHIVE_SUFFIX) or Path(source).is_dir()


def _best(sources: Sequence[str], words: Sequence[str]) -> tuple[Path, str]:
    """Return place and name of the finished run with the highest score, of those that the words choose."""
    from plab.results.table import readable_rows

    names = ("task", "variant", "method", "seed")
    chosen = select(words, names)
    found, _ = readable_rows([resolve(source) for source in sources])
    rows = [r for r in found if r.values["status"] == "finished" and chosen(r.values, r.config)]
    one_protocol(row.config for row in rows)
    if not rows:
        raise RenderError(f"there is no finished run to show in {', '.join(sources)}: no run fits")
    best = max(rows, key=lambda row: row.values["score"])
    task, variant, method, seed = (best.values[name] for name in names)
    return best.path, f"{task}-v{variant}-{method}-seed{seed}"


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
