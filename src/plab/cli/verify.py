"""Simulate submissions again and say what they really score, in float32 and in float64.

plab verify mine.plabsub.zip
plab verify submissions --run-policies sim.device=cuda

Exit code: 0 if all claims hold, 1 if one does not or was not run, 2 if a file cannot be judged. What was
found is kept beside each file, for plab.leaderboard. Plans are data; policies are programs of other people,
and run only if --run-policies is given.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import plab
from plab.cli.arguments import Parser, sources_and_words
from plab.cli.command import command_line
from plab.cli.tables import print_table
from plab.errors import PlabError, tell
from plab.scenes import PRECISIONS
from plab.submissions.collecting import submission_files
from plab.submissions.submission import SUFFIX, Submission, SubmissionError, read
from plab.submissions.verifying import Verification, verify, write_verification

__all__ = ["main"]

EXIT_NOT_TRUE = 1


@command_line
def main(argv: Sequence[str]) -> int:
    """Run the command line; return the exit code."""
    options = _parse(argv)
    sources, words = sources_and_words(options.arguments, default=None)
    precisions = PRECISIONS[:1] if options.float32 else PRECISIONS
    codes = []
    for path in _files(sources):
        try:
            codes.append(_run(path, words, options.run_policies, precisions))
        except PlabError as error:
            # A file that cannot be judged does not keep the others from it.
            tell(str(error))
            codes.append(error.exit_code)
    return max(codes)


def _files(sources: Sequence[Path]) -> list[Path]:
    found = []
    for source in sources:
        if source.is_file():
            # Whatever it is called: reading says what is wrong with it.
            found.append(source)
        elif not source.exists():
            raise SubmissionError(f"{source} does not exist")
        elif not (inside := submission_files(source)):
            raise SubmissionError(f"{source} has no submissions, files <name>{SUFFIX}")
        else:
            found += inside
    return found


def _run(path: Path, words: Sequence[str], run_policies: bool, precisions: Sequence[str]) -> int:
    submission = read(path)
    verification = verify(submission, words, run_policies=run_policies, precisions=precisions)
    _show(submission, verification, precisions)
    # Of a policy that was not run one line is enough.
    for why in dict.fromkeys(verdict.why for verdict in verification.verdicts if verdict.why):
        tell(f"{path}: {why}")
    kept = write_verification(verification, path)
    good = sum(verdict.outcome == "holds" for verdict in verification.verdicts)
    print(f"{path}: {good} of {len(verification.verdicts)} claim(s) hold; kept in {kept}")
    return 0 if good == len(verification.verdicts) else EXIT_NOT_TRUE


def _show(submission: Submission, verification: Verification, precisions: Sequence[str]) -> None:
    name = submission.card.name if submission.card else "a recording"
    version = f"plab {submission.plab}"
    if submission.plab != plab.__version__:
        version += f", simulated by plab {plab.__version__}"
    print(f"{name}: {submission.track}, {version}")
    rows = []
    for verdict in verification.verdicts:
        entry, scores = verdict.entry, verdict.scores
        numbers = [f"{scores[p]:.4f}" if p in scores else "" for p in precisions]
        first = scores.get(precisions[0])
        difference = "" if first is None else f"{first - entry.score:+.4f}"
        claim = (entry.configuration.name, f"{entry.steps:,}", f"{entry.score:.4f}")
        rows.append((*claim, *numbers, difference))
    print_table(("configuration", "steps", "claimed", *precisions, "difference"), rows)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("verify", __doc__)
    what = (
        f"files <name>{SUFFIX}, or folders of them; overrides, such as sim.device=cuda or targets.source=..."
    )
    parser.add_argument("arguments", nargs="+", help=what)
    what = "run the policies in the files: programs of other people, so do it where they can do no harm"
    parser.add_argument("--run-policies", action="store_true", help=what)
    parser.add_argument("--float32", action="store_true", help="leave float64 out")
    options = parser.parse_intermixed_args(argv)
    if all("=" in word for word in options.arguments):
        parser.error("name a submission, or a folder of them")
    return options
