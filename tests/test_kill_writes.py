"""Simulated runs that are killed at any file operation and resumed equal undisturbed runs."""

from __future__ import annotations

import gc
import random
import shutil
import sys
from pathlib import Path

import pytest

from faults import DEATH, Death, Failing, contents, watched
from plab.config import Config, load_config
from plab.results import read
from plab.runners import run_batch
from same_runs import CACHE

TD3 = """
method=td3 method.episodes=12 method.num_envs=2 method.evaluate_every=4 method.hidden=[8] method.batch_size=8
method.learning_starts=8 method.buffer_size=16 task=Move sim.grid_size=32 sim.horizon=4 sim.substeps=5
task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75] sim.particles_scale=0.03 checkpoint_seconds=0
progress=false
"""


def died(cfgs: list[Config], folder: Path, event: Failing) -> bool:
    """Execute runs; return whether they died."""
    try:
        with watched(folder, event):
            assert all(one.finished for one in run_batch(cfgs, cache=CACHE))
    except Death:
        return True
    finally:
        # Locks that nothing refers to are free, as are those of a process that is gone.
        gc.collect()
    return False


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc")
@pytest.mark.parametrize("runs", [1, 2])
def test_runs_that_die_at_any_event_end_with_the_same_files(tmp_path: Path, runs: int) -> None:
    folder, rng, deaths = tmp_path / "results", random.Random(0), 0
    cfgs = [load_config([*TD3.split(), f"results_dir={folder}", f"seed={seed}"]) for seed in range(runs)]
    count = Failing(-1, DEATH)
    assert not died(cfgs, folder, count)
    want = contents(folder)
    while deaths < 30:
        shutil.rmtree(folder)
        # Up to two thirds of an undisturbed run's events: most runs die several times.
        last = len(count.seen) * 2 // 3
        while died(cfgs, folder, Failing(rng.randrange(last) if deaths < 30 else -1, DEATH)):
            deaths += 1
            for path in folder.rglob("*.h5"):
                assert read(path).status == ("running" if ".partial." in path.name else "finished"), path
        assert contents(folder) == want
