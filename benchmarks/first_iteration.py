"""Seconds until a run shows its first iteration, without and with compiled kernels, and of other commands:
``python benchmarks/first_iteration.py ../before . task=Move``.

Words that are folders are checkouts of plab, timed in turns; all others are overrides.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

ROUNDS = 3

COMMANDS = {
    "import plab": ["-c", "import plab"],
    "import plab.sim": ["-c", "import plab.sim"],
    "plab run --help": ["-m", "plab", "run", "--help"],
    "plab run --cfg job": ["-m", "plab", "run", "--cfg", "job"],
    "plab status": ["-m", "plab", "status", "example"],
}


def seconds(checkout: str, words: list[str], cache: str, line: str = "") -> float:
    """Time a command, up to its first line of output that contains ``line`` if given."""
    folders = {"PLAB_CACHE_DIR": f"{cache}/plab", "TI_OFFLINE_CACHE_FILE_PATH": f"{cache}/taichi"}
    folders["PYTHONPATH"] = f"{Path(checkout).resolve()}/src"
    begin, end = time.perf_counter(), 0.0
    command = subprocess.Popen(
        [sys.executable, *words], env=os.environ | folders, cwd=cache, stdout=subprocess.PIPE, text=True
    )
    for printed in command.stdout or ():
        end = end or (time.perf_counter() - begin if line and line in printed else 0.0)
    if command.wait():
        sys.exit(f"{checkout}: {' '.join(words)} failed")
    return end or time.perf_counter() - begin


def main(words: list[str]) -> None:
    """Print name of the command, checkout, and minimum and median of the rounds [s]."""
    checkouts = [word for word in words if Path(word).is_dir()] or ["."]
    overrides = [word for word in words if word not in checkouts] or ["task=Move"]
    run = ["-m", "plab", "run", *overrides, "method.iterations=2"]
    taken: dict[tuple[str, str], list[float]] = defaultdict(list)
    for _ in range(ROUNDS):
        for checkout in checkouts:
            with tempfile.TemporaryDirectory() as cache:
                for seed, name in enumerate(("first run", "second run")):
                    taken[name, checkout].append(seconds(checkout, [*run, f"seed={seed}"], cache, "started"))
                for name, command in COMMANDS.items():
                    taken[name, checkout].append(seconds(checkout, command, cache))
    for (name, checkout), times in sorted(taken.items()):
        print(f"{name:20} {checkout:12} {min(times):6.2f} {statistics.median(times):6.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
