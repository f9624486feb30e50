"""Show, query, check, pack and unpack result files.

plab results scores [results] [task=...] --keys a,b  runs with their scores, and settings as columns
plab results sql "select ..." [results ...]         queries of the tables of docs/results.md
plab results check [results ...]                    check every file against the schema
plab results pack results --output runs.plab.zip.xz    put finished runs into one small file
plab results unpack runs.plab.zip.xz --output folder   restore the files of an archive
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from plab.cli.command import (
    Parser,
    add_forms,
    add_sources,
    command_line,
    folder,
    positive,
    print_table,
    results_source,
    sources_and_words,
)
from plab.config.selection import select
from plab.errors import print_error, printable
from plab.results.archive import pack, unpack
from plab.results.checking import check
from plab.results.run_file import NAMES, ResultsError
from plab.results.run_table import query, scores


@command_line
def main(argv: Sequence[str]) -> int | None:
    """Run the command line.

    Returns:
        Exit code: 0, 1 if ``check`` found a fault, 2 for invalid input.
    """
    parser = Parser("plab results", __doc__)
    parser.add_argument("command", choices=_COMMANDS, help="subcommand; each has its own --help")
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    first = parser.parse_args(argv)
    # Without subparsers, which do not support positional arguments on both sides of an option.
    return _COMMANDS[first.command](first.arguments)


def _scores(argv: Sequence[str]) -> None:
    """Print runs with their scores, one per line."""
    parser = Parser("plab results scores", _scores.__doc__)
    add_sources(parser, "runs: task=Rope,Move seed=0,1,2 (default: finished runs)")
    what = "additional columns, comma-separated: keys such as method.lr, or columns of plab.results.load"
    parser.add_argument("--keys", type=_names, default=[], help=what)
    parser.add_argument("--sort", type=_names, default=[], help="columns to sort by, separated by commas")
    parser.add_argument("--descending", action="store_true", help="sort in descending order")
    add_forms(parser)
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.sources)
    chosen = select(words, (*NAMES, "status"))
    if chosen.choices.setdefault("status", ["finished"]) == ["all"]:
        del chosen.choices["status"]
    table, unreadable = scores(sources, chosen, options.keys, options.sort, descending=options.descending)
    _report_skipped(unreadable)
    print_table(list(table.columns), table.astype(object).itertuples(index=False, name=None), options.form)


def _sql(argv: Sequence[str]) -> None:
    """Run an SQL query on the tables runs, config and iterations."""
    parser = Parser("plab results sql", _sql.__doc__)
    parser.add_argument("query", help='for example "select task, avg(score) from runs group by task"')
    add_sources(parser)
    add_forms(parser)
    options = parser.parse_intermixed_args(argv)
    columns, answer, unreadable = query(sources_and_words(options.sources)[0], options.query)
    _report_skipped(unreadable)
    print_table(columns, answer, options.form)


def _check(argv: Sequence[str]) -> int:
    """Check every file against the schema; exit code 1 if anything is wrong."""
    parser = Parser("plab results check", _check.__doc__)
    add_sources(parser)
    options = parser.parse_intermixed_args(argv)
    count = wrong = runs = 0
    for source in sources_and_words(options.sources)[0]:
        for path, fault in check(source):
            count += 1
            if fault:
                wrong += 1
                runs += path.suffix == ".h5" and path.is_file()
                print(printable(f"{path}: {fault}"), flush=True)
    advice = "; damaged .h5 files can be deleted and run again, or run with force=true" if runs else ""
    print(f"{count} run(s) checked, {wrong} faulty{advice}")
    return 1 if wrong else 0


def _pack(argv: Sequence[str]) -> None:
    """Pack finished runs into an archive."""
    parser = Parser("plab results pack", _pack.__doc__)
    add_sources(parser, "runs to select: task=Rope,Move")
    parser.add_argument("--output", type=folder, required=True, help="archive to write, <name>.plab.zip.xz")
    what = "significant digits of the iterations, >= 1 (default: all); 4 reduce the size by two thirds"
    parser.add_argument("--digits", type=positive, help=what)
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.sources)
    chosen = select(words, NAMES)
    count, unreadable = pack(sources, options.output, chosen, options.digits)
    _report_skipped(unreadable)
    print(f"{options.output}: {count} run(s), {options.output.stat().st_size / 1e3:.1f} kB")


def _unpack(argv: Sequence[str]) -> None:
    """Unpack the runs of an archive; existing files are unchanged."""
    parser = Parser("plab results unpack", _unpack.__doc__)
    parser.add_argument("archive", type=results_source, help="archive to read")
    parser.add_argument("--output", type=folder, default=Path("results"), help="folder to write to")
    options = parser.parse_intermixed_args(argv)
    written, kept = unpack(options.archive, options.output)
    there = f", {kept} existed already" if kept else ""
    print(f"{options.output}: {written} run(s) written{there}")


_COMMANDS = {"scores": _scores, "sql": _sql, "check": _check, "pack": _pack, "unpack": _unpack}


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def _report_skipped(unreadable: Iterable[ResultsError]) -> None:
    for error in unreadable:
        print_error(f"left out: {error}")
