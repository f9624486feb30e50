"""Trajectory losses in torch's autograd, and the policy network that is trained by them: a coarse scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from plab.config import Config, load_config
from plab.envs.core import EpisodeBatch
from plab.objective import scores
from plab.problem import Problem
from plab.results import BUDGETS, RunResult, read, result_path
from plab.runners import apg, run_config
from plab.runners.common import episode_columns
from plab.torch import TensorEnv, rollout
from same_runs import assert_same_numbers, stopped_at

pytestmark = pytest.mark.physics

HORIZON = 3
COARSE = [
    "task=Rope",
    "sim.grid_size=16",
    f"sim.horizon={HORIZON}",
    "sim.substeps=5",
    "sim.dt=4e-4",
    "sim.particles_scale=0.03",
    "task.manipulators.left.size=[0.06]",
    "task.manipulators.left.position=[0.25,0.0625,0.75]",
]


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Two environments of which the second has a softer rope."""
    first = load_config([*COARSE, "sim=reference"])
    return Problem([first, load_config([*COARSE, "sim=reference", "task.yield_stress=20"])])


def draw(seed: int, **options) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand((2, HORIZON, 6), generator=generator, dtype=torch.float64)
    return (1.6 * unit - 0.8).to(**options).requires_grad_()


def test_losses_and_gradients_are_the_simulators(problem: Problem) -> None:
    actions = draw(0)
    losses = rollout(problem, actions)
    losses.sum().backward()
    expected = problem.rollout(actions.detach().numpy(), gradient=True)
    np.testing.assert_array_equal(losses.detach().numpy(), expected.loss.sum(axis=1))
    np.testing.assert_array_equal(actions.grad.numpy(), expected.gradient)


def test_environments_of_tensors_do_what_those_of_arrays_do() -> None:
    cfgs = [load_config([*COARSE, "sim=reference", f"task.yield_stress={s}"]) for s in (20, 50)]
    env, arrays = TensorEnv(cfgs), EpisodeBatch(cfgs)
    np.testing.assert_array_equal(env.reset().numpy(), arrays.reset()[0])
    for t in range(HORIZON):
        actions = draw(t)[:, t].detach().float()
        got, want = env.step(actions), arrays.step(actions.numpy())
        np.testing.assert_array_equal(got.observation.numpy(), want.observation)
        np.testing.assert_array_equal(got.reward.numpy(), want.reward.astype(np.float32))
        assert got.info.keys() == want.info.keys() and got.truncated == want.truncated == (t == HORIZON - 1)


def test_each_environments_loss_is_weighed_on_its_own(problem: Problem) -> None:
    actions = draw(1)
    losses = rollout(problem, actions)
    (whole,) = torch.autograd.grad(losses.sum(), actions, retain_graph=True)
    (weighed,) = torch.autograd.grad(losses @ torch.tensor([0.0, 3.0], dtype=torch.float64), actions)
    assert torch.count_nonzero(weighed[0]) == 0
    torch.testing.assert_close(weighed[1], 3.0 * whole[1])


def test_gradient_agrees_with_differences(problem: Problem) -> None:
    actions, direction = draw(2), draw(3).detach()
    (gradient,) = torch.autograd.grad(rollout(problem, actions).sum(), actions)
    step = 1e-5
    with torch.no_grad():
        ahead, behind = (rollout(problem, actions + sign * step * direction).sum() for sign in (1, -1))
    assert float((gradient * direction).sum()) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-4)


def test_gradient_goes_on_through_what_the_actions_are_made_of(problem: Problem) -> None:
    scale = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    actions = draw(4).detach()
    rollout(problem, scale * actions).sum().backward()
    fixed = (0.5 * actions).requires_grad_()
    rollout(problem, fixed).sum().backward()
    assert float(scale.grad) == pytest.approx(float((fixed.grad * actions).sum()), rel=1e-12)


def test_beyond_its_bounds_an_action_has_no_gradient(problem: Problem) -> None:
    actions = draw(5).detach()
    actions[:, 1] = 1.5
    actions.requires_grad_()
    rollout(problem, actions).sum().backward()
    assert torch.count_nonzero(actions.grad[:, 1]) == 0 and torch.count_nonzero(actions.grad[:, 0]) > 0


def test_type_is_kept_and_no_gradient_is_computed_in_vain(problem: Problem, monkeypatch) -> None:
    actions = draw(6, dtype=torch.float32).detach().requires_grad_()
    losses = rollout(problem, actions)
    losses.sum().backward()
    assert losses.dtype == actions.grad.dtype == torch.float32
    wanted, intact = [], Problem.try_out
    monkeypatch.setattr(
        Problem,
        "try_out",
        lambda self, a, **options: (wanted.append(options["gradient"]), intact(self, a, **options))[1],
    )
    assert not rollout(problem, actions.detach()).requires_grad
    with torch.no_grad():
        rollout(problem, actions)
    assert wanted[0] is False


def test_there_is_no_second_derivative(problem: Problem) -> None:
    actions = draw(7)
    (gradient,) = torch.autograd.grad(rollout(problem, actions).square().sum(), actions, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


# ---------------------------------------------------------------- method=apg


ITERATIONS = 4
APG = [*COARSE, "method=apg", f"method.iterations={ITERATIONS}", "method.hidden=[16,16]", "progress=false"]


def make_config(folder: Path, *overrides: str) -> Config:
    return load_config([*APG, f"results_dir={folder}", *overrides])


def run(cfg: Config) -> RunResult:
    run_config(cfg)
    return read(result_path(cfg))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """An uninterrupted run."""
    return run(make_config(tmp_path_factory.mktemp("results"), "method.lr=0.01"))


def test_apg_lowers_the_loss(finished: RunResult) -> None:
    rows = finished.iterations
    assert rows["steps"].tolist() == [HORIZON * i for i in range(ITERATIONS)]
    spent = rows["steps_forward"].tolist(), rows["steps_gradient"].tolist()
    assert spent == ([HORIZON * (i + 1) for i in range(ITERATIONS)],) * 2
    measured = set(episode_columns(["density", "sdf", "contact"])) | set(BUDGETS)
    assert measured | {"iteration", "episodes", "steps", "gradient_norm", "seconds"} == set(rows.columns)
    assert rows["loss"].iloc[-1] < rows["loss"].iloc[0] and (rows["gradient_norm"] > 0).all()
    assert finished.best_loss == rows["loss"].min()
    judged = scores(finished.masses["initial"], finished.masses["final"], finished.masses["target"])
    assert finished.evaluation["score"] == judged.score


def test_apg_resumes_to_the_same_numbers(tmp_path: Path, finished: RunResult, monkeypatch) -> None:
    cfg = make_config(tmp_path, "method.lr=0.01")
    with stopped_at(2, apg, "rollout"):
        run_config(cfg)
    assert len(read(result_path(cfg).with_suffix(".partial.h5")).iterations) == 2
    again = run(cfg)
    assert_same_numbers(again, finished)
    assert again.provenance["resumed"] == 1
