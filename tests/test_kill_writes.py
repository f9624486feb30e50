"""Simulated runs that die at any change of a file and end, resumed, with the files of undisturbed ones."""

from __future__ import annotations

import gc
import random
import shutil
import sys
from pathlib import Path

import pytest

from faults import DEATH, Death, Failing, contents, watched
from plab.config import Config, load_config
from plab.results import read, result_path
from plab.runners import run_batch, run_config
from same_runs import KeepsAll

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc"),
]

CACHE = KeepsAll()

DEATHS = 30

COMMON = ("sim.substeps=5", "sim.particles_scale=0.03", "checkpoint_seconds=0", "progress=false")
SHORT = "sim.grid_size=16 sim.horizon=3 sim.dt=4e-4 method.iterations=3"
RL = "task=Move sim.grid_size=32 sim.horizon=4 method.episodes=12 method.num_envs=2 method.evaluate_every=4"
RL += " method.hidden=[8] task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]"
# A replay buffer that is written round and round.
OFF_POLICY = f"{RL} method.batch_size=8 method.learning_starts=8 method.buffer_size=16"
ON_POLICY = f"{RL} method.steps_per_update=10 method.minibatches=2 method.epochs=2"


def died(cfgs: list[Config], folder: Path, event: Failing) -> bool:
    """Carry out runs whose steps of a replay buffer, written by its mapping, are events, too."""
    from plab.runners.replay import EpisodeReplay

    add = EpisodeReplay.add
    try:
        with watched(folder, event), pytest.MonkeyPatch.context() as patch:
            patch.setattr(EpisodeReplay, "add", lambda *step: event("append", "") or add(*step))
            if len(cfgs) == 1:
                run_config(cfgs[0], CACHE)
            else:
                assert all(one.finished for one in run_batch(cfgs, cache=CACHE))
    except Death:
        return True
    finally:
        # Locks that nothing refers to are free, as are those of a process that is gone.
        gc.collect()
    return False


@pytest.mark.parametrize(
    ("words", "runs"),
    [
        pytest.param(f"method=adam {SHORT}", 2, id="adam"),
        pytest.param(f"method=cem method.population=4 method.elites=2 {SHORT}", 1, id="cem"),
        pytest.param(f"method=sac {OFF_POLICY}", 1, id="sac"),
        pytest.param(f"method=ppo {ON_POLICY}", 1, id="ppo"),
        pytest.param(f"method=td3 {OFF_POLICY}", 2, id="td3 population"),
        pytest.param(f"method=ppo {ON_POLICY}", 2, id="ppo population"),
    ],
)
def test_runs_that_die_at_any_event_end_with_the_same_files(tmp_path: Path, words: str, runs: int) -> None:
    folder, rng, deaths = tmp_path / "results", random.Random(0), 0
    settings = [*COMMON, *words.split(), f"results_dir={folder}"]
    cfgs = [load_config([*settings, f"seed={seed}"]) for seed in range(runs)]
    folder.mkdir()
    count = Failing(-1, DEATH)
    assert not died(cfgs, folder, count)
    want = contents(folder)
    while deaths < DEATHS:
        shutil.rmtree(folder)
        folder.mkdir()
        # Up to two thirds of an undisturbed run's events: most runs die several times.
        last = len(count.seen) * 2 // 3
        while died(cfgs, folder, Failing(rng.randrange(last) if deaths < DEATHS else -1, DEATH)):
            deaths += 1
            for path in folder.rglob("*.h5"):
                assert read(path).status == ("running" if ".partial." in path.name else "finished"), path
        got = contents(folder)
        assert got.keys() == want.keys()
        assert [name for name in want if got[name] != want[name]] == []
    assert any(read(result_path(cfg)).provenance["resumed"] for cfg in cfgs)
