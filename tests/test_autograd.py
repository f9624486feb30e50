"""Trajectory losses in torch's autograd, and training of a policy network with them, on a coarse scene."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded

from plab.config import load_config
from plab.envs.autograd import policy_gradient, rollout, simulate
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.problem import Problem
from plab.sim import SimulationError
from toy_runner import COARSE_ROPE

HORIZON = 3


@pytest.fixture(scope="module")
def episodes() -> EpisodeBatch:
    """Four environments, the second with a softer rope; the target is observed."""
    first = load_config([*COARSE_ROPE, "observe_target=1"])
    second = load_config([*COARSE_ROPE, "observe_target=1", "task.yield_stress=20"])
    return EpisodeBatch([first, second, first, first], contact="soft")


@pytest.fixture(scope="module")
def problem(episodes: EpisodeBatch) -> Problem:
    return episodes.problem


def draw(seed: int, **options) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand((4, HORIZON, 6), generator=generator, dtype=torch.float64)
    return (1.6 * unit - 0.8).to(**options).requires_grad_()


def test_losses_and_gradients_are_the_simulators(problem: Problem, monkeypatch) -> None:
    actions = draw(0)
    losses = rollout(problem, actions)
    losses.sum().backward()
    expected = problem.rollout(actions.detach().numpy(), gradient=True)
    np.testing.assert_array_equal(losses.detach().numpy(), expected.loss.sum(axis=1))
    np.testing.assert_array_equal(actions.grad.numpy(), expected.gradient)
    # Each environment's loss is weighed on its own, and there is no second derivative.
    whole, weights = actions.grad.clone(), torch.tensor([0.0, 3.0, 0.0, 0.0], dtype=torch.float64)
    (weighed,) = torch.autograd.grad(rollout(problem, actions) @ weights, actions)
    assert torch.count_nonzero(weighed[0]) == 0
    torch.testing.assert_close(weighed[1], 3.0 * whole[1])
    for loss in (rollout(problem, actions).sum(), simulate(problem.simulator, actions).x.sum()):
        with pytest.raises(RuntimeError, match="create_graph"):
            torch.autograd.grad(loss, actions, create_graph=True)
    # The type is kept, and no gradient is computed in vain.
    actions = draw(0, dtype=torch.float32).detach().requires_grad_()
    losses = rollout(problem, actions)
    losses.sum().backward()
    assert losses.dtype == actions.grad.dtype == torch.float32
    wanted, intact = [], Problem.rollout

    def counted(self, tried, *, gradient, **options):
        wanted.append(gradient)
        return intact(self, tried, gradient=gradient, **options)

    monkeypatch.setattr(Problem, "rollout", counted)
    assert not rollout(problem, actions.detach()).requires_grad
    with torch.no_grad():
        rollout(problem, actions)
    assert wanted == [False, False]
    # Integers are converted, so that losses and states are not cut to integers.
    ones = torch.ones(actions.shape, dtype=torch.int64)
    assert torch.equal(rollout(problem, ones), rollout(problem, ones.double()))
    assert simulate(problem.simulator, ones, material=torch.tensor(300.0)).x.dtype == torch.float64
    compiled = torch.compile(lambda tried: rollout(problem, tried) + 0, backend="eager")
    assert torch.equal(compiled(actions), rollout(problem, actions.detach().numpy()))
    with pytest.raises(TypeError, match="complex"):
        rollout(problem, ones.cfloat())


def test_environments_of_tensors_do_what_those_of_arrays_do(episodes: EpisodeBatch) -> None:
    actions = [draw(t)[:, t].detach().float() for t in range(HORIZON)]
    first, wanted = episodes.reset()[0], [episodes.step(action.numpy()) for action in actions]
    env = TensorEnv(episodes)
    np.testing.assert_array_equal(env.reset().numpy(), first)
    for t, (action, want) in enumerate(zip(actions, wanted, strict=True)):
        got = env.step(action)
        np.testing.assert_array_equal(got.observation.numpy(), want.observation)
        np.testing.assert_array_equal(got.reward.numpy(), want.reward.astype(np.float32))
        assert got.info.keys() == want.info.keys() and got.info["success"].dtype == torch.bool
        assert got.truncated.all() == want.truncated.all() == (t == HORIZON - 1)
    env.reset()
    assert env.step(torch.ones((4, 6), dtype=torch.int32)).reward.dtype == torch.float64


def test_gradient_goes_on_through_what_the_actions_are_made_of(problem: Problem) -> None:
    scale = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    actions = draw(4).detach()
    # Beyond its bounds an action has no gradient, at them it has.
    actions[:, 1], actions[:, 2] = 3.0, 2.0
    rollout(problem, scale * actions).sum().backward()
    fixed = (0.5 * actions).requires_grad_()
    rollout(problem, fixed).sum().backward()
    assert float(scale.grad) == pytest.approx(float((fixed.grad * actions).sum()), rel=1e-12)
    assert [bool(fixed.grad[:, t].any()) for t in range(HORIZON)] == [True, False, True]


# ---------------------------------------------------------------- a policy that reacts


def network(episodes: EpisodeBatch, outputs: int, seed: int = 0) -> torch.nn.Sequential:
    """Float64 network that depends on the observation."""
    entries = episodes.observation_space.shape[0]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = torch.nn.Linear(entries, 8), torch.nn.Tanh(), torch.nn.Linear(8, outputs), torch.nn.Tanh()
        made = torch.nn.Sequential(*layers).double()
    with torch.no_grad():
        made[0].weight *= 3.0
    return made


def test_the_whole_gradient_of_a_policy_agrees_with_differences(episodes: EpisodeBatch) -> None:
    policy, critic = network(episodes, 6), network(episodes, 1, seed=1)
    weights = torch.nn.utils.parameters_to_vector(policy.parameters()).detach()

    def loss() -> float:
        episodes.reset()
        policy.zero_grad()
        done = policy_gradient(episodes, policy, HORIZON, discount=0.8, value=lambda seen: critic(seen)[:, 0])
        total = sum(0.8**t * done.loss[t].mean() for t in range(HORIZON))
        return float(total - 0.8**HORIZON * critic(done.observations[-1]).detach().mean())

    loss()
    assert all(parameter.grad is None for parameter in critic.parameters())
    direction = torch.randn(weights.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    direction /= direction.norm()
    gradient = torch.nn.utils.parameters_to_vector([one.grad for one in policy.parameters()])
    along, step, beside = float(gradient @ direction), 1e-5, []
    for sign in (1, -1):
        torch.nn.utils.vector_to_parameters(weights + sign * step * direction, policy.parameters())
        beside.append(loss())
    assert along == pytest.approx((beside[0] - beside[1]) / (2 * step), rel=1e-6)


def test_stretches_follow_each_other_as_steps_do(episodes: EpisodeBatch) -> None:
    policy = network(episodes, 6)
    episodes.reset()
    parts = [policy_gradient(episodes, policy, steps) for steps in (1, HORIZON - 1)]
    with pytest.raises(ResetNeeded, match="the episode is over"):
        policy_gradient(episodes, policy, 1)
    observation, info = episodes.set_state(episodes.get_state())
    np.testing.assert_array_equal(observation, parts[1].observations[-1].float().numpy())
    np.testing.assert_array_equal(info["loss"], parts[1].loss[-1].numpy())
    observation, _ = episodes.reset()
    for t in range(HORIZON):
        part, k = (parts[0], t) if t < 1 else (parts[1], t - 1)
        np.testing.assert_array_equal(part.observations[k].float().numpy(), observation)
        step = episodes.step(part.actions[k].numpy())
        observation = step.observation
        np.testing.assert_allclose(part.loss[k].numpy(), step.info["loss"], rtol=1e-12)
    # More steps than are left are refused before the first.
    episodes.reset()
    with pytest.raises(ResetNeeded):
        policy_gradient(episodes, policy, HORIZON + 1)


def test_the_weights_of_the_loss_are_put_back(episodes: EpisodeBatch) -> None:
    actions = draw(9).detach().numpy()
    calls = count()

    def gradient() -> np.ndarray:
        return episodes.problem.rollout(actions, gradient=True).gradient

    before = gradient()

    def react(t: int, bar: np.ndarray | None) -> None:
        if next(calls) == 1:
            raise ArithmeticError("on the way back")

    episodes.reset()
    with pytest.raises(ArithmeticError):
        episodes.closed_loop(HORIZON, lambda t, seen: actions[:, 0], react, discount=0.5)
    np.testing.assert_array_equal(gradient(), before)
    episodes.reset()
    policy_gradient(episodes, network(episodes, 6), HORIZON, discount=0.5)
    np.testing.assert_array_equal(gradient(), before)
    episodes.reset()
    with pytest.raises(ValueError, match=r"\(4, 5\)"):
        policy_gradient(episodes, network(episodes, 5), HORIZON)
    for policy, steps, named in ((lambda seen: seen, 1, "parameters="), (network(episodes, 6), 0, "steps")):
        with pytest.raises(ValueError, match=named):
            policy_gradient(episodes, policy, steps)
    broken = episodes.get_state()
    broken.simulation.v[1] = 1e9
    episodes.set_state(broken)
    with pytest.raises(SimulationError, match="environment 1, environment step 1"):
        policy_gradient(episodes, network(episodes, 6), HORIZON)
