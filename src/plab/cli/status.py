"""Show finished, running, failed and missing runs.

Without arguments, show the runs in results. Selections such as task=Rope seed=0,1 request all combinations
of the given values, and also show missing runs; --missing requests the whole suite.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

from plab.cli.command import Parser, add_forms, add_sources, command_line, sources_and_words
from plab.config.selection import select
from plab.status.survey import NAMES, Survey, survey


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    parser = Parser("plab status", __doc__)
    add_sources(parser, "runs: task=Rope,Move variant=1 seed=0,1,2")
    what = "request the suite's tasks and variants, with the existing methods and seeds"
    parser.add_argument("--missing", action="store_true", help=what)
    what = "show every run, live, until all have ended"
    add_forms(parser).add_argument("--watch", action="store_const", dest="form", const="watch", help=what)
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.sources)
    chosen = select(words, NAMES)

    def look() -> Survey:
        return survey(sources, chosen, missing=options.missing)

    if options.form == "json":
        found = look()
        tables = {"runs": found.runs, "groups": found.groups}
        shown = {name: json.loads(table.to_json(orient="records")) for name, table in tables.items()}
        names = ("others", "unreadable", "protocol", "workers", "eta")
        print(json.dumps(shown | {name: getattr(found, name) for name in names}, indent=1))
    elif options.form == "csv":
        print(look().groups.to_csv(index=False), end="")
    else:
        # Imported here, because scripts need no tables.
        from plab.status.display import show, watch

        if options.form == "watch":
            watch(look)
        else:
            show(look())
