"""Mutation test of the test suite: the tests must detect the faults in mutants.yaml.

    python tools/mutation.py --log build/mutation.csv          # all faults; takes hours on two cores
    python tools/mutation.py --log build/mutation.csv --only 3,17

A fault is detected by a test that fails with it and passes without it. Each test file runs in one process;
files that mention the faulty module most run first. The log has a row per fault and file, from which a second
call resumes.
"""

from __future__ import annotations

import argparse
import csv
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
COPIED = ("src", "tests", "conf", "docs", "examples", "reports", "tools", "benchmarks")
HEADER = ("number", "area", "file", "tests", "found_by", "seconds")


def mutated_copy(root: Path, to: Path, mutant: dict[str, str]) -> None:
    """Copy a checkout by hard links and insert a fault; raise ValueError unless its text occurs once."""
    to.mkdir(parents=True)
    for name in filter(lambda name: (root / name).exists(), COPIED):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(root / name, to / name, copy_function=os.link, ignore=ignore)
    for path in filter(Path.is_file, root.iterdir()):
        os.link(path, to / path.name)
    path = to / mutant["file"]
    text = path.read_text(encoding="utf-8")
    if text.count(mutant["old"]) != 1:
        raise ValueError(f"{mutant['file']} must have this text once: {mutant['old']}")
    path.unlink()
    path.write_text(text.replace(mutant["old"], mutant["new"]), encoding="utf-8")


def by_relevance(root: Path, file: str, first: list[str]) -> list[str]:
    """Return the test files: named ones first, then those that mention a module most."""
    package, stem = Path(file).with_suffix("").parts[-2:]

    def mentions(path: Path) -> int:
        text = path.read_text(encoding="utf-8")
        named = 20 * (stem in path.stem) + 8 * (package in path.stem)
        return named + 5 * len(re.findall(rf"\b{stem}\b", text)) + len(re.findall(rf"\b{package}\b", text))

    paths = sorted((root / "tests").rglob("test_*.py"), key=lambda path: (-mentions(path), path.name))
    names = [str(path.relative_to(root)) for path in paths]
    return sorted(names, key=lambda name: first.index(name) if name in first else len(first))


@dataclass
class Suite:
    """Tests of a checkout, run one file at a time in processes pinned to one core each."""

    root: Path
    marks: str
    known: list[str]
    seconds: float
    cores: queue.Queue[int] = field(default_factory=queue.Queue)

    def __post_init__(self) -> None:
        for core in sorted(os.sched_getaffinity(0)):
            self.cores.put(core)

    def failing(self, folder: Path, tests: str, skipped: list[str]) -> str:
        """Return the first failing test, the file if the test is unknown, or nothing."""
        core = self.cores.get()
        path = os.pathsep.join([str(folder / "src"), os.environ.get("PYTHONPATH", "")])
        environment = os.environ | {
            "PYTHONPATH": path,
            "OMP_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        options = ["-x", "-q", "-rfE", "-p", "no:cacheprovider", "-p", "no:benchmark", "-m", self.marks]
        command = ["taskset", "-c", str(core), sys.executable, "-m", "pytest", *options, tests]
        command += [f"--deselect={test}" for test in skipped]
        try:
            with tempfile.TemporaryDirectory() as temporary:
                environment["TMPDIR"] = temporary
                done = subprocess.run(
                    command, cwd=folder, env=environment, timeout=self.seconds, text=True, capture_output=True
                )
        except subprocess.TimeoutExpired:
            return tests
        finally:
            self.cores.put(core)
        # 5: no test was selected.
        if done.returncode in (0, 5):
            return ""
        found = re.search(r"^(?:FAILED|ERROR) (tests/\S+(?:\[.*?\])?)(?: - |$)", done.stdout, re.MULTILINE)
        return found.group(1) if found else tests

    def finder(self, folder: Path, tests: str) -> str:
        """Return the test of a file that fails in a faulty copy and passes without the fault, or nothing."""
        skipped = [test for test in self.known if test.startswith(f"{tests}::")]
        if tests in self.known:
            return ""
        while found := self.failing(folder, tests, skipped):
            if not self.failing(self.root, found, skipped):
                return found
            if found == tests:
                break
            skipped.append(found)
        return ""


def main() -> None:
    """Try faults, write a row for each fault and test file, and print which faults are detected."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--log", type=Path, required=True, help="CSV file, continued if it exists")
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout whose tests are tried")
    parser.add_argument("--only", default="", help="numbers of faults, with commas between")
    parser.add_argument("--first", default="", help="test files to begin with, with commas between")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="files at once")
    parser.add_argument("--marks", default="not nightly and not gpu", help="pytest's -m")
    parser.add_argument("--known", type=Path, help="list of tests or files that fail without a fault, too")
    parser.add_argument("--seconds", type=float, default=900.0, help="time limit of a test file [s]")
    parser.add_argument("--deadline", type=float, default=1e9, help="no file is started after so long [s]")
    args = parser.parse_args()
    start, root = time.monotonic(), args.root.resolve()
    mutants = dict(enumerate(yaml.safe_load((ROOT / "tools/mutants.yaml").read_text(encoding="utf-8"))))
    numbers = [int(number) for number in args.only.split(",")] if args.only else list(mutants)
    suite = Suite(root, args.marks, args.known.read_text().split() if args.known else [], args.seconds)
    rows = list(csv.DictReader(args.log.open(encoding="utf-8"))) if args.log.exists() else []
    tried = {(int(row["number"]), row["tests"]) for row in rows}
    found = {int(row["number"]): row["found_by"] for row in rows if row["found_by"]}
    first = args.first.split(",") if args.first else []
    orders = {number: by_relevance(root, mutants[number]["file"], first) for number in numbers}
    work = [
        (number, order[rank]) for rank in range(200) for number, order in orders.items() if rank < len(order)
    ]
    open_files = dict.fromkeys(numbers, 0)
    with tempfile.TemporaryDirectory(dir=root.parent) as base, args.log.open("a", encoding="utf-8") as file:
        log = csv.writer(file)
        if not rows:
            log.writerow(HEADER)
        for number in numbers:
            mutated_copy(root, Path(base) / str(number), mutants[number])

        def try_one(number: int, tests: str) -> None:
            if number in found or (number, tests) in tried:
                return
            if time.monotonic() - start > args.deadline:
                open_files[number] += 1
                return
            began = time.monotonic()
            result = suite.finder(Path(base) / str(number), tests)
            if result:
                found[number] = result
            mutant = mutants[number]
            log.writerow(
                [number, mutant["area"], mutant["file"], tests, result, round(time.monotonic() - began)]
            )
            file.flush()

        with ThreadPoolExecutor(args.jobs) as pool:
            for job in [pool.submit(try_one, *one) for one in work]:
                job.result()
    for number in numbers:
        state = found.get(number) or (
            f"open, {open_files[number]} files" if open_files[number] else "NOT FOUND"
        )
        print(f"{number:3d} {mutants[number]['area']:11s} {mutants[number]['file']}: {state}")
    print(f"{sum(number in found for number in numbers)} of {len(numbers)} found")


if __name__ == "__main__":
    main()
