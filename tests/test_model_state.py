"""States of models as arrays: there and back through a result file, and states that are not the model's."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

import synthetic
from plab.config import load_config
from plab.results import read, write
from plab.runners.apg import PolicyTraining
from plab.runners.model_state import model_arrays, restore_model
from plab.runners.rl_models import model_kind

FEW = {
    "sac": ("method.batch_size=8", "method.learning_starts=12", "method.buffer_size=100"),
    "td3": ("method.batch_size=8", "method.learning_starts=12", "method.buffer_size=100"),
    "ppo": ("method.steps_per_update=10", "method.minibatches=2", "method.epochs=2"),
}


def make(name: str, seed: int) -> BaseAlgorithm:
    """An untrained model in an environment of Gymnasium's own."""
    method = load_config(["task=Move", f"method={name}", "method.hidden=[4]", *FEW[name]]).method
    env = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")])
    return model_kind(method.family, method.algorithm).make(method, env, seed)


@pytest.fixture(scope="module", params=FEW)
def trained(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Any, Any]:
    """A model after some updates: its name, its state, and the state as a result file gives it back."""
    model = make(request.param, 0)
    model.learn(30)
    state = model_arrays(model)
    path = tmp_path_factory.mktemp("state") / "run.partial.h5"
    run = synthetic.run(path.parent)
    run.resume = {"model": state}
    write(run, path)
    return request.param, state, read(path).resume["model"]


def assert_same(one: Any, other: Any, place: str = "") -> None:
    """Assert that two states agree, bit for bit."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), place
        for name, value in one.items():
            assert_same(value, other[name], f"{place}/{name}")
    else:
        assert np.asarray(one).dtype == np.asarray(other).dtype, place
        assert np.array_equal(one, other), place


def test_a_model_is_what_its_state_says(trained) -> None:
    name, state, back = trained
    assert_same(state, back)
    model = make(name, 1)
    assert not np.array_equal(*(s["networks"]["policy"][NAMES[name]] for s in (model_arrays(model), state)))
    restore_model(model, back)
    assert_same(model_arrays(model), state)
    # The state is no window on the model.
    before = copy.deepcopy(back)
    model.env.reset()
    model.learn(20, reset_num_timesteps=False)
    assert_same(back, before)
    assert model.num_timesteps > 30


NAMES = {"sac": "actor.mu.weight", "td3": "actor.mu.0.weight", "ppo": "action_net.weight"}


def _pickled(state: dict[str, Any]) -> Any:
    return np.zeros(8, np.uint8)


def _shape(state: dict[str, Any]) -> Any:
    parameters = state["networks"]["policy"]
    name = next(name for name in parameters if name.endswith("weight"))
    parameters[name] = parameters[name][:1, :1]
    return state


def _type(state: dict[str, Any]) -> Any:
    parameters = state["networks"]["policy"]
    name = next(name for name in parameters if name.endswith("weight"))
    parameters[name] = parameters[name].astype(np.float64)
    return state


def _name(state: dict[str, Any]) -> Any:
    state["networks"]["policy"]["other.weight"] = np.zeros(3)
    return state


def _moment(state: dict[str, Any]) -> Any:
    moments = next(iter(state["optimizers"].values()))
    moments["0"]["exp_avg"] = np.zeros(3, np.float32)
    return state


def _number(state: dict[str, Any]) -> Any:
    moments = next(iter(state["optimizers"].values()))
    moments["99"] = moments["0"]
    return state


def _value(state: dict[str, Any]) -> Any:
    state["values"]["policy"] = np.zeros(3)
    return state


def _observation(state: dict[str, Any]) -> Any:
    state["values"]["_last_obs"] = np.zeros((1, 9), np.float32)
    return state


MISFITS: dict[Callable[[dict[str, Any]], Any], str] = {
    _pickled: r"its networks are pickled, as by earlier versions of plab",
    _shape: r"weight has shape \[1, 1\], not \[",
    _type: r"weight holds float64, not float32",
    _name: r"its networks are others: other\.weight",
    _moment: r"exp_avg has shape \[3\], not \[",
    _number: r"the optimiser has no parameter 99",
    _value: r"it has no number policy",
    _observation: r"_last_obs has shape \[1, 9\], not \[1, 3\]",
}


@pytest.mark.parametrize("change", MISFITS, ids=lambda change: change.__name__)
def test_a_state_of_something_else_is_refused(trained, change: Callable[[dict[str, Any]], Any]) -> None:
    name, state, _ = trained
    with pytest.raises(ValueError, match=MISFITS[change]):
        restore_model(make(name, 1), change(copy.deepcopy(state)))


def test_a_policy_trained_by_gradient_has_arrays_too() -> None:
    method = load_config(["task=Move", "method=apg", "method.hidden=[4]"]).method
    first, second = (PolicyTraining(method, 3, 2, seed, torch.device("cpu")) for seed in (0, 1))
    x = torch.ones(5, 3)
    first.policy(x).square().sum().backward()
    first.improve()
    second.restore(copy.deepcopy(first.state()))
    assert_same(second.state(), first.state())
    for training in (first, second):
        training.policy(x).square().sum().backward()
        training.improve()
    assert_same(second.state(), first.state())
    with pytest.raises(ValueError, match="its network is pickled, as by earlier versions of plab"):
        second.restore({"training": np.zeros(8, np.uint8)})
