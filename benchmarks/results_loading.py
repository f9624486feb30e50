"""Time and memory for loading thousands of result files, with and without the index, and from an archive.

    python benchmarks/results_loading.py --runs 10000 --rows 5
    python benchmarks/results_loading.py --runs 1000 --archive

writes small result files to a temporary folder and loads them: for the first time, again, and after one of
them has changed. Status, tables and a query follow.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sized
from pathlib import Path

from plab.cli.command import measure_table
from plab.config.selection import Selection
from plab.report.collect import collect
from plab.report.writing import write_tables
from plab.results import load, pack
from plab.results.run_table import query, scores
from plab.status import survey
from synthetic_runs import SETTLE, write_runs

__all__ = ["main", "measure"]


def measure(runs: int, rows: int, packed: bool) -> Iterator[dict[str, object]]:
    """Write the files and measure; yield a row per loading method, optionally including archives."""
    with tempfile.TemporaryDirectory() as name:
        folder, results, every = Path(name), Path(name) / "results", Selection()
        os.environ["PLAB_CACHE_DIR"] = str(folder / "cache")
        write_runs(runs, rows, results)
        time.sleep(SETTLE)

        def timed(what: str, call: Callable[[], Sized]) -> dict[str, object]:
            start = time.perf_counter()
            count = len(call())
            seconds = time.perf_counter() - start
            first.setdefault("seconds", seconds)
            ratio = round(first["seconds"] / seconds, 1)
            return {"what": what, "count": count, "seconds": round(seconds, 3), "times_faster": ratio}

        first: dict[str, float] = {}
        yield timed("first time", lambda: load(results))
        yield timed("again", lambda: load(results))
        changed = load(results)["path"].iloc[runs // 2]
        Path(changed).touch()
        yield timed("one changed", lambda: load(results))
        yield timed("with a key", lambda: load(results, keys=["method.family"]))
        yield timed("without index", lambda: load(results, index=False))
        yield timed("scores", lambda: scores(results, every, ["method.lr"], ["score"])[0])
        yield timed("sql", lambda: query(results, "select task, avg(score) from runs group by task")[1])
        yield timed("plab.status", lambda: survey(results, every).runs)
        yield timed("tables, first time", lambda: write_tables(collect(results, every), folder / "a", ""))
        yield timed("tables, again", lambda: write_tables(collect(results, every), folder / "b", ""))
        if not packed:
            return
        archive = folder / "all.plab.zip.xz"
        yield timed("pack", lambda: range(pack(results, archive)[0]))
        time.sleep(SETTLE)
        yield timed("archive", lambda: load(archive))
        yield timed("archive again", lambda: load(archive))


def main() -> None:
    """Print a row per measurement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=5000, help="number of result files")
    parser.add_argument("--rows", type=int, default=5, help="iterations of each")
    parser.add_argument("--archive", action="store_true", help="pack them, too, and load the archive")
    options = parser.parse_args()
    rows = measure(options.runs, options.rows, options.archive)
    measure_table(("what", "count", "seconds", "times_faster"), rows, None)
    # Linux counts in KiB, macOS in bytes.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1024.0)
    print(f"peak memory: {peak:.0f} MiB")


if __name__ == "__main__":
    main()
