"""Choice of a rollout on a command line: a run's best actions, or the best actions known for a task."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plab.cli.arguments import Parser, positive, sources_and_words
from plab.config import load_config
from plab.config.compose import check_sources
from plab.config.selection import one_protocol, select
from plab.config.words import IDLE, require_effect
from plab.render.graphics import RenderError

if TYPE_CHECKING:
    from plab.config import Config

__all__ = ["WITHOUT_EFFECT", "make_parser", "rollout", "settle"]

WITHOUT_EFFECT = ("method", "seed", "sim.memory_mb", *IDLE)
"""Keys of a configuration that change no picture."""


def make_parser(name: str, text: str, every: str) -> Parser:
    """Return a parser with the arguments that choose a rollout, of which ``every`` says what has a frame
    every K environment steps."""
    parser = Parser(name, text)
    add = parser.add_argument
    add(
        "what",
        nargs="*",
        metavar="RESULTS | KEY=VALUE",
        help="keys are those of plab run",
    )
    add("--every", type=positive, metavar="K", help=f"{every} has a frame every K environment steps")
    add("--config-dir", metavar="FOLDER", help="folder with tasks of your own, as for plab run")
    return parser


def settle(arguments: argparse.Namespace, ending: str) -> None:
    """Find the rollout, as far as can be done without simulating.

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
    sources, words = sources_and_words(arguments.what, default=None)
    if sources and all(map(_holds_many, sources)):
        arguments.result, name = _best(sources, words)
        return Path(f"{name}{ending}")
    require_effect(words, WITHOUT_EFFECT, "a picture")
    if len(sources) > 1 or (sources and words):
        raise RenderError(f"give one result file or overrides (KEY=VALUE), not '{' '.join(arguments.what)}'")
    if sources:
        # Imported here: it loads pandas, for which no mistake above should have to wait.
        from plab.results.run_file import split_archive

        arguments.result = sources[0]
        folder = Path() if split_archive(arguments.result) else arguments.result.parent
        return folder / (arguments.result.stem + ending)
    if not words:
        raise RenderError("say what to show: a result file, or a task such as task=Torus; --help explains")
    arguments.result = None
    cfg = arguments.config = load_config(words, arguments.config_dir)
    check_sources(cfg)
    return Path(f"{cfg.task.name}-v{cfg.variant}{ending}")


def _holds_many(source: Path) -> bool:
    """Return whether a source is a folder or an archive of results."""
    # Imported here, as below: it loads pandas, for which no mistake should have to wait.
    from plab.results.schema import ARCHIVE_SUFFIX

    return str(source).endswith(ARCHIVE_SUFFIX) or source.is_dir()


def _best(sources: Sequence[Path], words: Sequence[str]) -> tuple[Path, str]:
    """Return place and name of the finished run with the highest score, of those that the words choose."""
    from plab.results.table import readable_rows

    names = ("task", "variant", "method", "seed")
    chosen = select(words, names)
    found, _ = readable_rows(sources)
    rows = [r for r in found if r.values["status"] == "finished" and chosen(r.values, r.config)]
    one_protocol(row.config for row in rows)
    if not rows:
        raise RenderError(f"there is no finished run to show in {', '.join(map(str, sources))}: no run fits")
    best = max(rows, key=lambda row: row.values["score"])
    task, variant, method, seed = (best.values[name] for name in names)
    return best.path, f"{task}-v{variant}-{method}-seed{seed}"


def rollout(arguments: argparse.Namespace) -> tuple[Config, np.ndarray]:
    """Return configuration and actions, shape [T, A], of the rollout that :func:`settle` found."""
    from plab.render import recording

    if arguments.result:
        return recording.result(arguments.result)
    return arguments.config, recording.demonstration(arguments.config)
