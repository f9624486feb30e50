"""Model-predictive control: executed actions are evaluated, runs resume, planners are interchangeable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plab.config import Config, ConfigError, load_config
from plab.runners import run_config
from same_runs import CACHE, finished_as, run, stopped_at
from toy_runner import COARSE_32

COARSE = (
    "task=Move", "method=mpc", *COARSE_32, "sim.horizon=5",
    "method.window=3", "method.execute=2", "method.planner.iterations=2",
    "checkpoint_seconds=0", "progress=false",
)  # fmt: skip
CEM = ("method.planner.population=4", "method.planner.elites=2")


def config(folder: Path | str, *words: str) -> Config:
    return load_config([*COARSE, *words, f"results_dir={folder}"])


@pytest.mark.parametrize("words", [CEM, ("method@method.planner=adam",)], ids=["cem", "adam"])
def test_what_is_executed_is_what_is_judged_and_resumes(words: tuple[str, ...], tmp_path: Path) -> None:
    cfg = config(tmp_path / "a", *words)
    result = run(cfg)
    last = result.iterations.iloc[-1]
    assert result.rows == 3 and result.best_iteration == 2 and np.abs(result.best_actions).max() > 0
    for name in ("loss", "loss_density", "reward", "score"):
        assert last[name] == pytest.approx(result.evaluation[name], rel=1e-6, abs=1e-9)
    # Plans look 3, 3 and 1 steps ahead, with 2, 2 and 1 executed.
    tried, own = (7 * 2 * 4, "steps_forward") if words is CEM else (7 * 2, "steps_gradient")
    assert last[own] == tried + (5 if words is CEM else 0)
    again = config(tmp_path / "b", *words)
    with stopped_at(2):
        run_config(again, CACHE)
    run(again)
    finished_as(again, result)


def test_mistakes_are_named() -> None:
    for words, named in ((["method.execute=4"], "execute"), (["method@method.planner=sac"], "planner=sac")):
        with pytest.raises(ConfigError, match=rf"method\.{named}"):
            config("results", *words)
