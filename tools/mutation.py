"""Mutation test of the test suite: each fault of mutants.yaml is put into a copy of plab, and the tests have to find it.

    python tools/mutation.py --jobs 2 --out tools/mutants_found.csv     # all of them; takes hours on two cores
    python tools/mutation.py --only 3,17                                # two of them, by number

A fault is found by the first test that fails with it and passes without it. Test files run in the order in which they mention the faulty
module, each in a process of its own, as `make test` selects them.
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
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
COPIED = ("src", "tests", "conf", "docs", "examples", "reports", "tools", "benchmarks")


def copy(root: Path, to: Path) -> None:
    """Copy a checkout without its environment, its history and its results, by hard links."""
    to.mkdir(parents=True)
    for name in COPIED:
        if (root / name).exists():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(root / name, to / name, copy_function=os.link, ignore=ignore)
    for path in root.iterdir():
        if path.is_file():
            os.link(path, to / path.name)


def mutate(folder: Path, mutant: dict[str, str]) -> None:
    """Write the fault into a copy; ValueError unless the faulty text is there exactly once."""
    path = folder / mutant["file"]
    text = path.read_text(encoding="utf-8")
    if text.count(mutant["old"]) != 1:
        raise ValueError(f"{mutant['file']}: {text.count(mutant['old'])} times: {mutant['old']}")
    path.unlink()
    path.write_text(text.replace(mutant["old"], mutant["new"]), encoding="utf-8")


def ordered(folder: Path, file: str) -> list[Path]:
    """Return the test files, those first that mention a module most."""
    parts = Path(file).with_suffix("").parts[1:]
    stem, package = parts[-1], parts[-2]

    def mentions(path: Path) -> int:
        text = path.read_text(encoding="utf-8")
        named = 20 * (stem in path.stem) + 8 * (package in path.stem)
        return named + 5 * len(re.findall(rf"\b{stem}\b", text)) + len(re.findall(rf"\b{package}\b", text))

    return sorted((folder / "tests").rglob("test_*.py"), key=lambda path: (-mentions(path), path.name))


class Suite:
    """Runs test files of a copy in processes of their own."""

    def __init__(self, marks: str, seconds: float, pin: bool) -> None:
        """Keep the marks to select by, the time limit of a file [s], and whether jobs stay on one core."""
        self.marks, self.seconds = marks, seconds
        self.cores: queue.Queue[int] = queue.Queue()
        for core in sorted(os.sched_getaffinity(0)):
            self.cores.put(core)
        self.pin = pin

    def fails(self, folder: Path, tests: str, core: int, skipped: list[str]) -> str | None:
        """Return the first failing test of a file, or the file if none can be named, or None."""
        environment = os.environ | {
            "PYTHONPATH": f"{folder / 'src'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        }
        environment |= {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-rfE",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:benchmark",
        ]
        command += ["-m", self.marks, tests, *(f"--deselect={test}" for test in skipped)]
        if self.pin:
            command = ["taskset", "-c", str(core), *command]
        with tempfile.TemporaryDirectory() as temporary:
            environment["TMPDIR"] = temporary
            try:
                done = subprocess.run(
                    command,
                    cwd=folder,
                    env=environment,
                    timeout=self.seconds,
                    text=True,
                    stdout=-1,
                    stderr=-2,
                )
            except subprocess.TimeoutExpired:
                return f"{tests} (time limit)"
        # 5: nothing selected.
        if done.returncode in (0, 5):
            return None
        found = re.search(r"^(?:FAILED|ERROR) (\S+(?:\[.*?\])?)(?: - |$)", done.stdout, re.MULTILINE)
        return found.group(1) if found else tests

    def finder(self, root: Path, mutant: dict[str, str]) -> tuple[str, float]:
        """Return the test that finds a fault, or nothing, and how long that took [s]."""
        start, core = time.monotonic(), self.cores.get()
        base = Path(tempfile.mkdtemp(prefix="plab-mutant-", dir=root.parent))
        try:
            copy(root, base / "mutant")
            copy(root, base / "clean")
            mutate(base / "mutant", mutant)
            for path in ordered(base / "mutant", mutant["file"]):
                tests, skipped = str(path.relative_to(base / "mutant")), list[str]()
                while found := self.fails(base / "mutant", tests, core, skipped):
                    name = found.removesuffix(" (time limit)")
                    if self.fails(base / "clean", name, core, []) is None:
                        return found, time.monotonic() - start
                    if name == tests:
                        break
                    skipped.append(name)
            return "", time.monotonic() - start
        finally:
            shutil.rmtree(base, ignore_errors=True)
            self.cores.put(core)


def main() -> None:
    """Test all faults, or some, and write a row for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout whose tests are tried")
    parser.add_argument("--only", default="", help="numbers of faults, with commas between")
    parser.add_argument("--jobs", type=int, default=2, help="faults tried at once")
    parser.add_argument("--marks", default="not nightly and not gpu", help="pytest's -m")
    parser.add_argument("--seconds", type=float, default=900.0, help="time limit of a test file")
    parser.add_argument("--pin", action="store_true", help="keep each job on a core of its own")
    parser.add_argument("--out", type=Path, default=Path("mutants_found.csv"))
    args = parser.parse_args()
    mutants = list(enumerate(yaml.safe_load((ROOT / "tools/mutants.yaml").read_text(encoding="utf-8"))))
    if args.only:
        mutants = [mutants[int(number)] for number in args.only.split(",")]
    suite = Suite(args.marks, args.seconds, args.pin)
    with ThreadPoolExecutor(args.jobs) as pool, open(args.out, "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["number", "area", "file", "found_by", "seconds"])
        jobs = {pool.submit(suite.finder, args.root.resolve(), mutant): (n, mutant) for n, mutant in mutants}
        for job in as_completed(jobs):
            (number, mutant), (found, seconds) = jobs[job], job.result()
            rows.writerow([number, mutant["area"], mutant["file"], found, round(seconds)])
            file.flush()
            print(f"{number:3d} {mutant['file']}: {found or 'NOT FOUND'} ({seconds:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
