"""The command ``plab`` and its subcommands.

plab run task=Rope method=adam seed=0     one run, or a sweep with -m
plab status                               finished, running, failed and missing runs
plab report tables                        tables, curves, notebooks or a page of results
plab results scores                       scores, SQL, checks and archives of results
plab render task=Rope                     pictures and films of runs
plab view task=Rope                       a 3-D page of a run
plab export task=Rope                     a run as files for other programs
plab demonstrations                       best known actions of the suite
plab dataset task=Move                    demonstrations as datasets in Minari's format
plab targets                              targets of tasks
plab submit, verify, leaderboard          results to publish, and tables of them
plab bench speed                          benchmarks of speed, accuracy, stability, policies

Each has its own --help.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pkgutil import resolve_name

from plab.errors import PlabError, print_error, suggest

COMMANDS = {
    "run": "plab.cli.run:main",
    "status": "plab.cli.status:main",
    "report": "plab.cli.report:main",
    "results": "plab.cli.results:main",
    "render": "plab.cli.rollouts:render",
    "view": "plab.cli.rollouts:view",
    "export": "plab.cli.rollouts:export",
    "demonstrations": "plab.cli.suite:demonstrations",
    "dataset": "plab.cli.dataset:main",
    "targets": "plab.cli.suite:targets",
    "submit": "plab.cli.submissions:submit",
    "verify": "plab.cli.submissions:verify",
    "leaderboard": "plab.cli.submissions:leaderboard",
    "bench": "plab.bench:main",
}
"""Module and function of each subcommand."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand; return its exit code."""
    name, *rest = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print((__doc__ or "").partition("\n\n")[2].rstrip())
        return 0
    if name not in COMMANDS:
        print_error(f"unknown command {name}; {suggest(name, list(COMMANDS))}")
        return PlabError.exit_code
    return int(resolve_name(COMMANDS[name])(rest))
