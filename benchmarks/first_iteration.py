"""Seconds until a run shows its first iteration, without and with compiled kernels, and of other commands:
``python benchmarks/first_iteration.py ../before . task=Move``.

Words that are folders are checkouts of plab, timed in turns; all others are overrides.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from statistics import median

ROUNDS = 3

COMMANDS = {
    "import plab.sim": ["-c", "import plab.sim"],
    "plab run --help": ["-m", "plab", "run", "--help"],
    "plab run --cfg job": ["-m", "plab", "run", "--cfg", "job"],
    "plab status": ["-m", "plab", "status", "example"],
}


def seconds(checkout: str, words: list[str], cache: str, line: str = "") -> tuple[float, float]:
    """Time a command, up to its first line of output that contains ``line`` if given: wall and CPU time."""
    caches = {"PLAB_CACHE_DIR": f"{cache}/plab"} | {
        f"{compiler}_OFFLINE_CACHE_FILE_PATH": f"{cache}/kernels" for compiler in ("TI", "QD")
    }
    env = os.environ | caches | {"PYTHONPATH": f"{Path(checkout).resolve()}/src"}
    begin = time.perf_counter()
    child = subprocess.Popen([sys.executable, *words], env=env, cwd=cache, stdout=subprocess.PIPE, text=True)
    next((printed for printed in child.stdout or () if line and line in printed), None)
    ticks = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    taken = time.perf_counter() - begin, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
    child.communicate()
    if child.returncode:
        sys.exit(f"{checkout}: {' '.join(words)} failed")
    return taken


def main(words: list[str]) -> None:
    """Print command, checkout, and minimum and median of the wall and the CPU time [s]."""
    checkouts = [word for word in words if Path(word).is_dir()] or ["."]
    overrides = [word for word in words if word not in checkouts] or ["task=Move"]
    run = ["-m", "plab", "run", *overrides, "method.iterations=2"]
    taken = defaultdict(list)
    for _ in range(ROUNDS):
        for checkout in checkouts:
            with tempfile.TemporaryDirectory() as cache:
                for seed, name in enumerate(("first run", "second run")):
                    taken[name, checkout].append(seconds(checkout, [*run, f"seed={seed}"], cache, "started"))
                for name, command in COMMANDS.items():
                    taken[name, checkout].append(seconds(checkout, command, cache))
    for (name, checkout), times in sorted(taken.items()):
        shown = [f"{of(column):6.2f}" for column in zip(*times, strict=True) for of in (min, median)]
        print(f"{name:20} {checkout:12}", *shown)


if __name__ == "__main__":
    main(sys.argv[1:])
