"""Show what is done, running, failed and missing.

The runs that the results have. Words choose among them as those of a sweep do, and ask for all combinations
of what they name, so that those which are not there are missing; --missing asks for the whole suite.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

from plab.cli.arguments import Parser, sources_and_words
from plab.cli.command import command_line
from plab.cli.tables import print_table
from plab.config.selection import select
from plab.results.examples import EXAMPLES, resolve
from plab.status.survey import NAMES, STATES, Survey, survey

__all__ = ["main"]


@command_line
def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = Parser("plab.status", __doc__)
    where = f"folders of results, archives, or of {', '.join(EXAMPLES)} (default: results)"
    what = f"{where}, and runs: task=Rope,Move variant=1 seed=0,1,2"
    parser.add_argument("arguments", nargs="*", metavar="results | name=value", help=what)
    what = "ask for the suite's tasks and variants, of the methods and seeds that there are"
    parser.add_argument("--missing", action="store_true", help=what)
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--watch", action="store_true", help="show every run, live, until all have ended")
    form.add_argument("--json", action="store_true", help="print everything, for scripts")
    form.add_argument("--csv", action="store_true", help="print the table, for scripts")
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.arguments)
    given, chosen = [resolve(source) for source in sources or ["results"]], select(words, NAMES)

    def look() -> Survey:
        return survey(given, chosen, missing=options.missing)

    if options.json:
        found = look()
        print(json.dumps(asdict(found) | {"workers": found.workers, "eta": found.eta}, indent=1))
    elif options.csv:
        columns = ("task", "method", "expected", *STATES, "mean_seconds", "rate", "left")
        groups = [asdict(group) | group.counts for group in look().groups]
        print_table(columns, ([group[name] for name in columns] for group in groups), "csv")
    else:
        # Imported here: scripts need no tables.
        from plab.status.view import show, watch

        if options.watch:
            watch(look)
        else:
            show(look())
