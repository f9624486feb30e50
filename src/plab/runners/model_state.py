"""Networks, optimisers and models as arrays under names: what checkpoints and policies hold of them.

Nothing is pickled. Whoever reads a state makes the network, the optimiser or the model anew from the
configuration, and then puts the arrays where they belong: names and shapes have to be its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer

from plab.runners.common import checked_array

if TYPE_CHECKING:
    # Open-loop methods do without the library.
    from stable_baselines3.common.base_class import BaseAlgorithm

__all__ = [
    "alike",
    "model_arrays",
    "module_arrays",
    "moments",
    "optimizer_arrays",
    "restore_model",
    "restore_module",
    "restore_optimizer",
    "restore_policy",
]

_PICKLED = "its networks are pickled, as by earlier versions of plab"

_LIKE_PARAMETERS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer")
"""What torch's optimisers keep of each parameter that has its shape."""


def alike(array: Any, own: Tensor, name: str) -> Tensor:
    """Return an array of a state as a tensor with memory of its own, in shape, type and device like
    ``own``; ValueError, with the array's name, if its shape or type is another."""
    dtype = str(own.dtype).removeprefix("torch.")
    return torch.tensor(checked_array(array, own.shape, dtype, name), device=own.device)


def moments(state: Mapping[str, Any], parameter: Tensor) -> dict[str, Tensor]:
    """Return what an optimiser keeps of a parameter, from one entry of :func:`optimizer_arrays`;
    ValueError if it is another's."""
    if not isinstance(state, Mapping):
        raise ValueError("the optimiser's state is none")
    return {
        name: alike(array, parameter, name) if name in _LIKE_PARAMETERS else torch.tensor(np.asarray(array))
        for name, array in state.items()
    }


def module_arrays(module: torch.nn.Module) -> dict[str, np.ndarray]:
    """Return copies of a module's parameters and buffers by their names."""
    return {name: _array(tensor) for name, tensor in module.state_dict().items()}


def restore_module(module: torch.nn.Module, arrays: Mapping[str, Any]) -> None:
    """Give a module the parameters of :func:`module_arrays`; ValueError if they are another module's."""
    own = module.state_dict()
    if other := own.keys() ^ arrays.keys():
        raise ValueError(f"its networks are others: {min(other)}")
    module.load_state_dict({name: alike(arrays[name], tensor, name) for name, tensor in own.items()})


def optimizer_arrays(optimizer: Optimizer) -> dict[str, dict[str, np.ndarray]]:
    """Return copies of what an optimiser keeps of its parameters, by their numbers; rates are left out."""
    states = optimizer.state_dict()["state"]
    return {
        str(number): {name: _array(value) for name, value in own.items() if value is not None}
        for number, own in states.items()
    }


def restore_optimizer(optimizer: Optimizer, arrays: Mapping[str, Any]) -> None:
    """Give an optimiser what :func:`optimizer_arrays` has of the same parameters; ValueError if it is of
    others."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    states = {}
    for number, own in arrays.items():
        if not (number.isdecimal() and int(number) < len(parameters)):
            raise ValueError(f"the optimiser has no parameter {number}")
        parameter = parameters[int(number)]
        kept = moments(own, parameter)
        states[int(number)] = {name: value.to(parameter.device) for name, value in kept.items()}
    optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})


def model_arrays(model: BaseAlgorithm) -> dict[str, Any]:
    """Return all of a model of Stable-Baselines3 that training changes, except buffers.

    These are the networks, the optimisers, further variables, and counters and latest observations: those of
    its attributes that are numbers. All other attributes the configuration makes again.
    """
    networks, optimizers = _parts(model)
    _, variables = model._get_torch_save_params()
    return {
        "networks": {name: module_arrays(module) for name, module in networks.items()},
        "optimizers": {name: optimizer_arrays(optimizer) for name, optimizer in optimizers.items()},
        "variables": {name: _array(attrgetter(name)(model)) for name in variables},
        "values": {name: np.array(model.__dict__[name]) for name in _counters(model, none=False)},
    }


def restore_model(model: BaseAlgorithm, state: Mapping[str, Any]) -> None:
    """Give a new model what :func:`model_arrays` has of one of the same configuration; ValueError if it is
    of another, or was pickled."""
    if not isinstance(state, Mapping):
        raise ValueError(_PICKLED)
    networks, optimizers = _parts(model)
    _, variables = model._get_torch_save_params()
    wanted = {"networks": [*networks], "optimizers": [*optimizers], "variables": variables}
    for part, names in wanted.items():
        if other := {*names} ^ {*state[part]}:
            raise ValueError(f"its {part} are others: {min(other)}")
    for name, module in networks.items():
        restore_module(module, state["networks"][name])
    for name, optimizer in optimizers.items():
        restore_optimizer(optimizer, state["optimizers"][name])
    for name in variables:
        own = attrgetter(name)(model)
        own.data.copy_(alike(state["variables"][name], own, name))
    _restore_counters(model, state["values"])


def restore_policy(policy: torch.nn.Module, state: Mapping[str, Any]) -> None:
    """Give a new policy the networks that :func:`model_arrays` has of the policy of a model.

    Raises:
        ValueError: If it is that of another model, or was pickled.
    """
    if not isinstance(state, Mapping):
        raise ValueError(_PICKLED)
    restore_module(policy, state["networks"]["policy"])


def _restore_counters(model: BaseAlgorithm, values: Mapping[str, Any]) -> None:
    known = _counters(model, none=True)
    observed = (model.n_envs, *(model.observation_space.shape or ()))
    shapes = {"_last_obs": observed, "_last_original_obs": observed, "_last_episode_starts": observed[:1]}
    for name, value in values.items():
        if name not in known or not isinstance(value, np.ndarray):
            raise ValueError(f"it has no number {name}")
        own = model.__dict__[name]
        shape = shapes.get(name, np.shape(own) if own is not None else value.shape)
        if value.shape != shape:
            raise ValueError(f"{name} has shape {list(value.shape)}, not {list(shape)}")
        setattr(model, name, value.item() if value.ndim == 0 else value.copy())


def _parts(model: BaseAlgorithm) -> tuple[dict[str, torch.nn.Module], dict[str, Optimizer]]:
    """Return the networks and the optimisers of a model, by the names of Stable-Baselines3's own files."""
    names, _ = model._get_torch_save_params()
    parts = {name: attrgetter(name)(model) for name in names}
    optimizers = {name: part for name, part in parts.items() if isinstance(part, Optimizer)}
    return {name: part for name, part in parts.items() if name not in optimizers}, optimizers


def _counters(model: BaseAlgorithm, *, none: bool) -> list[str]:
    """Return the names of a model's attributes that are numbers, or arrays of them, or None if ``none``."""
    names, variables = model._get_torch_save_params()
    left_out = {*model._excluded_save_params(), *(name.split(".")[0] for name in (*names, *variables))}
    return [
        name
        for name, value in model.__dict__.items()
        if name not in left_out
        and (
            isinstance(value, bool | int | float | np.number | np.bool_)
            or (isinstance(value, np.ndarray) and value.dtype.kind in "biuf")
            or (none and value is None)
        )
    ]


def _array(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy().copy() if isinstance(value, Tensor) else np.asarray(value)
