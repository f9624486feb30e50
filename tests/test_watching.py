"""What is seen of a run while it lasts and at its end: compiling, contact model, what to do next."""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from plab import progress
from plab.cli.next_steps import next_steps
from plab.cli.run import main
from plab.config import load_config
from plab.results import RunFile
from plab.results import read as read_result
from plab.runners.jobs import Job
from plab.sim.compiling import watch_compiling

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")


@pytest.fixture
def screen(monkeypatch) -> io.StringIO:
    """A terminal."""
    text = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda: Console(file=text, force_terminal=True, width=120))
    return text


# ------------------------------------------------------------------------------------------------ compiling


def test_a_bar_says_which_kernel_is_compiled_and_for_how_long(screen, monkeypatch) -> None:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    tells: list[Callable[[str], None]] = []

    @contextmanager
    def compiler(tell: Callable[[str], None]) -> Iterator[None]:
        tells.append(tell)
        yield

    with progress.show_progress("Rope", 0, 8, compiling=compiler) as report:
        tells[0]("step_kernel")
        assert "compiling step_kernel, 0 s" in screen.getvalue()
        now[0] += 65.0
        tells[0]("step_adjoint_kernel")
        now[0] += 7.0
        tells[0]("losses_kernel")
        tells[0]("")
        report(1, "loss 2")
    first, last = screen.getvalue().split("compiling losses_kernel, 0 s")
    assert "compiling step_adjoint_kernel, 0 s" in first
    assert "loss 2" in last and "compiling" not in last.rsplit("Rope", 1)[1]


def test_the_time_of_compiling_goes_on(screen, monkeypatch) -> None:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])

    @contextmanager
    def compiler(tell: Callable[[str], None]) -> Iterator[None]:
        tell("step_kernel")
        now[0] += 65.0
        yield

    with progress.show_waiting("Rope build", compiler):
        pass
    assert "Rope build compiling step_kernel, 65 s" in screen.getvalue()


def test_elsewhere_than_on_a_terminal_nothing_watches_the_compiler(capsys) -> None:
    def compiler(tell: Callable[[str], None]):
        raise AssertionError

    with progress.show_waiting("Rope build", compiler):
        pass
    with progress.show_progress("Rope", 0, 8, compiling=compiler) as report:
        report(8, "loss 2")
    assert capsys.readouterr().out == "Rope 8/8, started, loss 2\n"


def test_kernels_are_told_when_they_are_compiled_and_cost_nothing_after() -> None:
    from taichi.lang import kernel_impl

    from plab.problem import Problem

    cfgs = [load_config(["task=Rope", *COARSE])]
    entry = kernel_impl._get_tree_and_ctx
    told: list[str] = []
    with watch_compiling(told.append):
        problem = Problem(cfgs)
        scene = problem.scenes[0]
        actions = np.zeros((1, scene.horizon, scene.action_dim))
        problem.rollout(actions, gradient=True)
        assert {"step_kernel", "losses_kernel", "step_adjoint_kernel"} <= set(told)
        # Each begins and ends before the next begins.
        assert all(told[0::2]) and not any(told[1::2]) and len(told) % 2 == 0
        told.clear()
        problem.rollout(actions, gradient=True)
        assert told == []
    assert kernel_impl._get_tree_and_ctx is entry
    kernels = [getattr(type(problem.simulator._engine), name) for name in ("step_kernel", "losses_kernel")]
    assert all("launch_kernel" not in vars(kernel._primal) for kernel in kernels)


def test_the_bar_of_a_run_says_what_is_compiled_and_the_contact_model(tmp_path, screen, capsys) -> None:
    argv = ["task=Rope", *COARSE, "sim.horizon=2", "method.iterations=2", f"results_dir={tmp_path}"]
    assert main(argv) == 0
    seen = screen.getvalue()
    assert "Rope-v1 adam seed 0 build" in seen and "Rope-v1 adam seed 0 final evaluation" in seen
    assert re.search(r"compiling \w+, \d+ s", seen)
    assert re.search(r"loss [\d.]+ soft score \d\.\d{3} best", seen)


# ------------------------------------------------------------------------------------------------- last lines


def finished(folder: Path, shown: float, judged: float, *words: str, **more: float) -> Job:
    """A run whose best iteration has one score and more columns, and whose final evaluation another score."""
    cfg = load_config([*words, f"results_dir={folder}"])
    run = RunFile(cfg)
    row = {"iteration": 0, "episodes": 0, "steps": 0, "loss": 1.5, "reward": 2.0, "iou": 0.4, "score": shown}
    run.record(row | more, {}, best_actions=np.zeros((50, 6)), best_iteration=0, best_loss=1.5)
    numbers = dict.fromkeys(("loss", "reward", "iou", "score_printed", "iou_initial", "iou_target_self"), 0.5)
    run.finish(numbers | {"score": judged}, {})
    return Job(cfg, run)


def test_a_score_that_differs_from_the_bars_is_explained(tmp_path) -> None:
    assert finished(tmp_path, 0.734, 0.6132).told == (
        "score 0.6132 in the hard contact model (0.7340 in the soft one of its iterations)"
    )


@pytest.mark.parametrize(
    ("shown", "judged", "words"),
    [(0.61324, 0.61321, ()), (0.7, 0.6132, ("method=adam_h",)), (0.7, 0.6132, ("method=cem",))],
)
def test_a_score_in_the_same_contact_model_needs_no_words(tmp_path, shown, judged, words) -> None:
    assert finished(tmp_path, shown, judged, *words).told == "score 0.6132"


def test_the_releases_score_is_that_of_the_last_iteration(tmp_path) -> None:
    assert finished(tmp_path, 0.7, 0.6, "protocol=release").told == "score 0.7000"


@pytest.mark.parametrize(
    ("trained", "told"),
    [
        (0.5, "score 0.5000 in its last training episodes (0.7000 without exploration)"),
        (np.nan, "score 0.7000"),
    ],
)
def test_the_releases_score_of_a_policy_is_that_of_its_training(tmp_path, trained: float, told: str) -> None:
    words = "protocol=release", "method=ppo"
    columns = {"train_reward": 1.0, "train_score": trained}
    assert finished(tmp_path, 0.7, 0.6, *words, **columns).told == told


def test_a_run_ends_with_two_lines_of_what_to_do_next() -> None:
    words = ["task=Move", "method.lr=0.05", "sim.horizon=60"]
    first, second = next_steps(load_config(words), words)
    assert re.fullmatch(r"a picture: python -m plab.render results/Move-v1/adam/seed0-\w{8}\.h5", first)
    assert second == "a page with curves and tables: python -m plab.report html --results results"


@pytest.mark.parametrize(
    ("quick", "full"),
    [
        (["method.iterations=20", "seed=3"], "seed=3"),
        (["sim.particles_scale=0.2", "task=Move", "force=true"], "task=Move"),
        (["task=Move", "sim.grid_size=32", "sim.dt=2e-4", "sim.substeps=10"], "task=Move"),
        (["method=sac", "method.episodes=100", "results_dir=my runs"], "method=sac 'results_dir=my runs'"),
        (["method=solve", "method.stages.polish.iterations=1"], "method=solve"),
        (["method.iterations=20"], ""),
    ],
)
def test_a_quick_run_says_that_it_does_not_compare_and_how_the_full_one_goes(quick, full) -> None:
    first, second = next_steps(load_config(quick), quick)
    folder = "'my runs'" if "my runs" in full else "results"
    assert first.endswith(f"; a page with curves and tables: python -m plab.report html --results {folder}")
    told = "this was a quick run, which does not compare with others; the full one: python -m plab.run"
    assert second == f"{told} {full}".rstrip()
    whole = load_config(shlex.split(second.partition("plab.run")[2]))
    assert whole.method.name == load_config(quick).method.name and whole.sim == load_config().sim


def test_the_full_run_of_ones_own_task_keeps_the_folder() -> None:
    own = str(Path(__file__).parents[1] / "examples" / "own_task" / "conf")
    words = ["task=Dumbbell", "method.iterations=5"]
    second = next_steps(load_config(words, own), words, own)[1]
    assert second.endswith(f"plab.run task=Dumbbell --config-dir {own}")


def test_the_last_lines_of_a_real_run(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    argv = ["task=Rope", *COARSE, "sim.horizon=2", "method.iterations=1"]
    assert main(argv) == 0
    *_, score, picture, full = capsys.readouterr().out.splitlines()
    assert score.startswith("finished: score 0.0000, results/Rope-v1/adam/seed0-")
    assert picture.startswith(f"a picture: python -m plab.render {score.rpartition(' ')[2]}; a page ")
    assert full.endswith("the full one: python -m plab.run task=Rope")
    assert main([*argv, "progress=false"]) == 0
    assert capsys.readouterr().out == f"finished before: {score.partition(': ')[2]}\n"


# ------------------------------------------------------------------------------------------ what a kill keeps


def test_the_first_iteration_is_kept_at_once(tmp_path, monkeypatch, capsys) -> None:
    kept: list[int] = []
    record = RunFile.record

    def look(run: RunFile, *args, **kwargs) -> None:
        record(run, *args, **kwargs)
        kept.append(len(read_result(run.partial_path).iterations))

    monkeypatch.setattr(RunFile, "record", look)
    words = ["checkpoint_seconds=1e6", "sim.horizon=2", "method.iterations=3", f"results_dir={tmp_path}"]
    assert main(["task=Rope", *COARSE, *words]) == 0
    # Later ones follow after checkpoint_seconds.
    assert kept == [1, 1, 1]
