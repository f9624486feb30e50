"""The command line of result files.

python -m plab.results check [results ...]                    check every file against the schema
python -m plab.results pack results --output runs.plab.zip    put finished runs into one small file
python -m plab.results unpack runs.plab.zip --output folder   make files of them again
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from plab.arguments import folder, positive
from plab.command import command_line
from plab.possible import require_possible
from plab.results.archive import pack, unpack
from plab.results.checking import check
from plab.results.loading import Row, readable_rows
from plab.results.schema import STATUSES
from plab.selection import Selection, SelectionError, select

__all__ = ["main"]

SELECTABLE = ("task", "variant", "method", "seed", "status")


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        Exit code: 0, 1 if ``check`` found something wrong, 2 for a mistake of the user's.
    """
    options = _parse(argv)
    return options.run(options)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="plab.results",
        description=__doc__.splitlines()[0],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = {"check": _check_parser, "pack": _pack_parser, "unpack": _unpack_parser}
    parser.add_argument("command", choices=commands, help="what to do; it has a --help of its own")
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    first = parser.parse_args(argv)
    command = commands[first.command](argparse.ArgumentParser(prog=f"plab.results {first.command}"))
    # Not by subparsers: they cannot have words on both sides of an option.
    return command.parse_intermixed_args(first.arguments)


def _check_parser(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.description = "Check every file against the schema; exit code 1 if anything is wrong."
    parser.add_argument(
        "sources", nargs="*", type=folder, default=["results"], help="folders, files, archives"
    )
    parser.set_defaults(run=_check)
    return parser


def _pack_parser(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.description = "Put runs into one small file."
    parser.add_argument("source", type=folder, help="folder, file or archive")
    what = "runs to take, e.g. task=Rope,Move method=adam status=all; by default those that are finished"
    parser.add_argument("words", nargs="*", help=what)
    parser.add_argument("--output", type=folder, required=True, help="archive to write, <name>.plab.zip")
    parser.add_argument("--masses", action="store_true", help="keep the mass tensors")
    what = "significant digits that the iterations keep, >= 1 (default: all); 4 halve an archive"
    parser.add_argument("--digits", type=positive, help=what)
    parser.add_argument("--resume", action="store_true", help="keep the state of unfinished runs")
    parser.set_defaults(run=_pack)
    return parser


def _unpack_parser(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.description = "Make files of the runs of an archive; files that are there stay."
    parser.add_argument("archive", type=folder, help="archive to read")
    parser.add_argument("--output", type=folder, default=Path("results"), help="folder to write to")
    parser.set_defaults(run=_unpack)
    return parser


def _check(options: argparse.Namespace) -> int:
    count = wrong = 0
    for source in options.sources:
        for _, problem in check(source):
            count += 1
            if problem is not None:
                wrong += 1
                print(f"{problem.path}: {problem.reason}: {problem.advice}", flush=True)
    print(
        f"{count} run(s) checked, {wrong} with something wrong"
        if wrong
        else f"{count} run(s) checked, all well"
    )
    return 1 if wrong else 0


def _pack(options: argparse.Namespace) -> int:
    chosen = select(options.words, SELECTABLE)
    _require_statuses(chosen.choices.get("status", ()))
    if options.words:
        others = {name: texts for name, texts in chosen.choices.items() if name != "status"}
        require_possible(Selection(others, chosen.keys), readable_rows(options.source)[0])
    done = pack(
        options.source,
        options.output,
        wanted=_wanted(chosen),
        keep_masses=options.masses,
        keep_resume=options.resume,
        digits=options.digits,
    )
    for error in done.unreadable:
        print(f"plab: left out: {error}", file=sys.stderr)
    size = f"{done.archive_bytes / 1e3:.1f} kB, {done.archive_bytes / done.runs / 1e3:.1f} kB per run"
    before = f"; {done.file_bytes / 1e3:.1f} kB as files" if done.file_bytes else ""
    print(f"{options.output}: {done.runs} run(s), {size}{before}")
    return 0


def _require_statuses(texts: Sequence[str]) -> None:
    for text in texts:
        if text not in (*STATUSES, "all"):
            raise SelectionError(f"status '{text}' does not exist; choose from: {', '.join(STATUSES)}, all")


def _wanted(chosen: Selection) -> Callable[[Row], bool]:
    """Take finished runs unless the words say something about the status."""
    statuses = chosen.choices.setdefault("status", ["finished"])
    if statuses == ["all"]:
        del chosen.choices["status"]
    return lambda row: chosen(row.values, row.config)


def _unpack(options: argparse.Namespace) -> int:
    written, kept = unpack(options.archive, options.output)
    there = f", {kept} there already" if kept else ""
    print(f"{options.output}: {written} run(s) written{there}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
