"""Pack what a method produced into one file for the leaderboard.

plab submit recordings --card card.yaml --output mine.plabsub.zip
plab submit results method=adam seed=0 --card card.yaml --output adam.plabsub.zip
plab submit --policy Move=move.pt --steps 100000 --card card.yaml --output policy.plabsub.zip

Recordings are written by plab.submissions.record; words such as method=adam choose among results. A policy
is run here, to see what it reaches; overrides such as sim.device=cuda may follow.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from plab.cli.arguments import Parser, seed, sources_and_words, to_write
from plab.cli.command import command_line
from plab.config.selection import select
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.submissions.collecting import from_policies, from_sources
from plab.submissions.submission import (
    CARD_BYTES,
    SUFFIX,
    UNSEEN,
    Submission,
    SubmissionError,
    inconsistency,
    parse_card,
    write,
)

__all__ = ["main"]

_NAMES = ("task", "variant", "method", "seed")


@command_line
def main(argv: Sequence[str]) -> int:
    """Run the command line; return the exit code."""
    options = _parse(argv)
    try:
        with options.card.open("rb") as file:
            card = parse_card(file.read(CARD_BYTES + 1), str(options.card))
    except OSError as error:
        raise SubmissionError(f"cannot read {options.card}: {error.strerror or error}") from None
    sources, words = sources_and_words(options.sources, default=None)
    if options.policy:
        variants = (*SUITE_VARIANTS, *UNSEEN) if options.unseen else SUITE_VARIANTS
        entries, files = from_policies(dict(options.policy), variants, options.steps, words)
        submission = Submission(card, tuple(entries), files)
    else:
        submission = Submission(card, tuple(from_sources(sources, select(words, _NAMES))))
    if fault := inconsistency(submission):
        raise SubmissionError(fault)
    write(submission, options.output)
    configurations = {entry.configuration for entry in submission.entries}
    size = options.output.stat().st_size / 1e3
    print(f"{options.output}: {submission.track} for {len(configurations)} configuration(s), {size:.1f} kB")
    return 0


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("submit", __doc__)
    what = "folders of recordings or results, archives; words that choose runs; with --policy, overrides"
    parser.add_argument("sources", nargs="*", metavar="RESULTS | KEY=VALUE", help=what)
    parser.add_argument("--card", type=Path, required=True, help="YAML file about the method")
    parser.add_argument("--output", type=to_write, required=True, help=f"file to write, <name>{SUFFIX}")
    what = "TASK=FILE: TorchScript (.pt) or ONNX (.onnx) for a task's variants; may be repeated"
    parser.add_argument("--policy", type=_policy, action="append", default=[], help=what)
    what = "with --policy: environment steps that the training of each policy took"
    parser.add_argument("--steps", type=seed, help=what)
    what = f"with --policy: act in the {len(UNSEEN)} unseen configurations of the task, too"
    parser.add_argument("--unseen", action="store_true", help=what)
    options = parser.parse_intermixed_args(argv)
    sources, _ = sources_and_words(options.sources, default=None)
    if bool(options.policy) == bool(sources):
        parser.error("give either recordings or results, or --policy")
    if bool(options.policy) != (options.steps is not None):
        parser.error("--policy and --steps go together")
    if options.unseen and not options.policy:
        parser.error("--unseen is for --policy")
    return options


def _policy(text: str) -> tuple[str, Path]:
    """Read ``Move=move.pt``."""
    task, _, name = text.partition("=")
    path = Path(name)
    if task not in suite_tasks() or path.suffix not in (".pt", ".onnx"):
        raise argparse.ArgumentTypeError(f"'{text}' is not like Move=move.pt or Move=move.onnx")
    return task, path
