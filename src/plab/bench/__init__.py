"""Benchmarks of speed, accuracy, stability and policies; each module has its own command line."""

from __future__ import annotations

import importlib
from collections.abc import Sequence

from plab.cli.command import command_line
from plab.errors import ArgumentError, suggest

BENCHMARKS = ("speed", "accuracy", "stability", "unseen")


@command_line
def main(argv: Sequence[str]) -> int:
    """Run the benchmark named by the first argument; return its exit code."""
    name, *rest = list(argv) or ["--help"]
    if name in ("-h", "--help"):
        print(f"plab bench NAME ...: {', '.join(BENCHMARKS)}; each has its own --help")
        return 0
    if name not in BENCHMARKS:
        raise ArgumentError(f"unknown benchmark {name}; {suggest(name, BENCHMARKS)}")
    return int(importlib.import_module(f"plab.bench.{name}").main(rest))
