"""The commands ``plab submit``, ``verify`` and ``leaderboard``."""

from __future__ import annotations

import shlex
from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path

import plab
from plab.cli.command import Parser, command_line, folder, positive, print_table, sources_and_words, to_write
from plab.config.selection import select
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.errors import PlabError, print_error
from plab.report.page import asset, render
from plab.report.statistics import BUDGETS
from plab.results.run_file import replace_file
from plab.submissions import verifying
from plab.submissions.board import board
from plab.submissions.submission import (
    SUFFIX,
    UNSEEN,
    Submission,
    SubmissionError,
    excess,
    parse_card,
    read,
    write,
)
from plab.submissions.verifying import HOLDS, NOT_RUN, TOLERANCE, submission_files
from plab.targets.build import PHYSICS_VERSION

_PACKAGE = "plab.submissions"
"""Folder of the page templates."""


@command_line
def submit(argv: Sequence[str]) -> None:
    """Pack the results of a method into one file for the leaderboard.

    plab submit recordings --card card.yaml --output mine.plabsub.zip
    plab submit results method=adam seed=0 --card card.yaml --output adam.plabsub.zip
    plab submit --policy Move=move.pt --steps 100000 --card card.yaml --output policy.plabsub.zip

    Recordings are written by plab.submissions.record; selections such as method=adam apply to results.
    Policies are executed to compute their scores; overrides such as sim.device=cuda may follow.
    """
    parser = Parser("plab submit", submit.__doc__)
    add = parser.add_argument
    what = "folders of recordings or results, archives; selections of runs; with --policy, overrides"
    add("sources", nargs="*", metavar="RESULTS | KEY=VALUE", help=what)
    add("--card", type=Path, required=True, help="YAML file that describes the method")
    add("--output", type=to_write, required=True, help=f"file to write, <name>{SUFFIX}")
    what = "TASK=FILE: TorchScript (.pt) or ONNX (.onnx) for a task's variants; may be repeated"
    add("--policy", type=_policy, action="append", default=[], help=what)
    add("--steps", type=positive, help="with --policy: environment steps used to train each policy")
    what = f"with --policy: evaluate in the {len(UNSEEN)} unseen configurations of the task, too"
    add("--unseen", action="store_true", help=what)
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.sources, default=None)
    if bool(options.policy) == bool(sources):
        parser.error("use either recordings or results, or --policy")
    if bool(options.policy) != (options.steps is not None):
        parser.error("--policy and --steps must be used together")
    if options.unseen and not options.policy:
        parser.error("--unseen requires --policy")
    card = parse_card(options.card.read_bytes(), str(options.card))
    if options.policy:
        variants = (*SUITE_VARIANTS, *UNSEEN) if options.unseen else SUITE_VARIANTS
        entries, files = verifying.from_policies(dict(options.policy), variants, options.steps, words)
        submission = Submission(card, tuple(entries), files)
    else:
        chosen = select(words, ("task", "variant", "method", "seed"))
        submission = Submission(card, tuple(verifying.from_sources(sources, chosen)))
    if fault := excess(submission):
        raise SubmissionError(f"{options.output}: {fault}")
    write(submission, options.output)
    configurations = {entry.configuration for entry in submission.entries}
    size = options.output.stat().st_size / 1e3
    print(f"{options.output}: {submission.track} for {len(configurations)} configuration(s), {size:.1f} kB")


def _policy(text: str) -> tuple[str, Path]:
    """Parse ``Move=move.pt``."""
    task, _, name = text.partition("=")
    path = Path(name)
    if task not in suite_tasks() or path.suffix not in (".pt", ".onnx"):
        raise ArgumentTypeError(f"'{text}' must have the form Move=move.pt or Move=move.onnx")
    return task, path


@command_line
def verify(argv: Sequence[str]) -> int:
    """Simulate submissions again and print their scores.

    plab verify mine.plabsub.zip
    plab verify submissions --run-policies sim.device=cuda

    Exit code: 0 if all claims hold, 1 if a claim does not hold or was not run, 2 if a file cannot be
    verified. The outcome is stored beside each file, for plab leaderboard. Plans are data; policies are
    programs written by others, and executed only with --run-policies.
    """
    parser = Parser("plab verify", verify.__doc__)
    what = f"files <name>{SUFFIX}, or folders of them; overrides, such as sim.device=cuda"
    parser.add_argument("arguments", nargs="+", help=what)
    what = "run the policies in the files, which are programs written by others: use a sandbox"
    parser.add_argument("--run-policies", action="store_true", help=what)
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.arguments, default=None)
    if not sources:
        parser.error("name a submission file or a folder")
    if missing := [source for source in sources if not submission_files(source)]:
        raise SubmissionError(f"there are no submissions, files <name>{SUFFIX}, at {missing[0]}")
    codes = []
    for path in (path for source in sources for path in submission_files(source)):
        try:
            submission = read(path)
            verdicts = verifying.verify(submission, words, run_policies=options.run_policies)
        except PlabError as error:
            # An invalid file does not prevent the verification of others.
            print_error(str(error))
            codes.append(error.exit_code)
            continue
        rows = [
            (one.entry.configuration.name, one.entry.steps, one.entry.score, one.score, one.outcome)
            for one in verdicts
        ]
        print_table(("configuration", "steps", "claimed", "score", "outcome"), rows)
        # One line suffices for policies that were not run.
        for why in dict.fromkeys(one.why for one in verdicts if one.why):
            print_error(f"{path}: {why}")
        good = sum(one.outcome == HOLDS for one in verdicts)
        kept = ""
        if any(one.outcome != NOT_RUN for one in verdicts):
            # Otherwise, the outcome of an earlier verification remains.
            kept = f"; written to {verifying.write_verification(verdicts, submission, words)}"
        print(f"{path}: {good} of {len(verdicts)} claim(s) hold{kept}")
        codes.append(int(good < len(verdicts)))
    return max(codes)


@command_line
def leaderboard(argv: Sequence[str]) -> None:
    """Write a static page for a folder of submissions: tracks, equal budgets, a table per protocol.

    plab leaderboard submissions
    plab leaderboard submissions --output public/leaderboard

    Run plab verify on the folder first; the page shows its stored outcomes. The page is index.html, and needs
    no server.
    """
    parser = Parser("plab leaderboard", leaderboard.__doc__)
    parser.add_argument("folder", type=folder, help="folder of submissions")
    what = "settings of your own leaderboard, such as sim.grid_size=32"
    parser.add_argument("overrides", nargs="*", help=what)
    what = "folder to write to (default: reports/leaderboard)"
    parser.add_argument("--output", type=folder, default=Path("reports/leaderboard"), help=what)
    options = parser.parse_intermixed_args(argv)
    sections, left_out = board(options.folder, options.overrides)
    html = render(
        "leaderboard.html",
        _PACKAGE,
        style=asset("page.css") + asset("leaderboard.css", _PACKAGE),
        script=asset("theme.js") + asset("leaderboard.js", _PACKAGE),
        sections=sections,
        left_out=left_out,
        budgets=[f"{count / 1e6:g}M" if count >= 1e6 else f"{count / 1e3:g}k" for count in BUDGETS],
        tasks=suite_tasks(),
        tolerance=TOLERANCE,
        origin={
            "command": shlex.join(["plab", "leaderboard", *argv]),
            "plab": plab.__version__,
            "physics": PHYSICS_VERSION,
            "overrides": options.overrides,
        },
    )
    path = options.output / "index.html"
    replace_file(path, html)
    for line in left_out:
        print_error(f"left out: {line}")
    print(f"{path}: {sum(len(section['lines']) for section in sections)} lines")
