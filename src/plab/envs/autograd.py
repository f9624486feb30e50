"""Differentiable PyTorch functions of the simulator: trajectory losses of actions; states for custom losses,
also with respect to initial state and material; and closed-loop policy gradients.

With ``sim.device=cuda`` tensors stay on the device.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from plab.envs.core import EpisodeBatch
from plab.envs.tensors import floating, simulator_input
from plab.errors import ArgumentError
from plab.sim.state import require_none

if TYPE_CHECKING:
    from plab.problem import Problem
    from plab.sim import RecordedStates, Simulator, State


@torch._disable_dynamo
def rollout(problem: Problem, actions: torch.Tensor) -> torch.Tensor:
    """Simulate actions from the initial states, and return the trajectory losses, differentiable with respect
    to the actions.

    The contact model is that of the problem's simulator. The gradient is for a sequence of independent
    actions: it does not include dependencies of the actions, such as on observations. Actions outside [-1, 1]
    are clipped and have no gradient. The gradient is computed together with the losses if the actions require
    gradients; second derivatives are not supported.

    Args:
        problem: Scenes, targets and simulator.
        actions: Actions, shape [batch, T, A], on any device; integers become floating-point numbers of the
            simulator's precision.

    Returns:
        Sum of the weighted step losses of each environment, shape [batch], with the type and device of
        ``actions``.

    Errors are those of :meth:`plab.sim.Simulator.rollout`.
    """
    actions = floating(actions, problem.simulator)
    # Inside an autograd.Function, gradient recording is always disabled.
    return _Rollout.apply(actions, problem, actions.requires_grad and torch.is_grad_enabled())


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, actions: torch.Tensor, problem: Problem, gradient: bool) -> torch.Tensor:
        given = simulator_input(actions, problem.simulator)
        result = problem.rollout(given, gradient=gradient, strict=False, exact=False)
        require_none(result.failures)
        if gradient:
            ctx.save_for_backward(torch.as_tensor(result.gradient).to(actions))
        return torch.as_tensor(problem.batch_measures(result)["loss"]).to(actions)

    @staticmethod
    def backward(ctx: Any, loss_bar: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        if torch.is_grad_enabled():
            raise RuntimeError("rollout has no second derivatives: omit create_graph=True")
        (gradient,) = ctx.saved_tensors
        return loss_bar[:, None, None] * gradient, None, None


class States(NamedTuple):
    """States after environment steps, each of shape [batch, T, ...]; T is 1 for the last state only.

    Attributes:
        x: Particle positions [domain units], shape [batch, T, particle, 3].
        v: Particle velocities, likewise.
        poses: Position (3), quaternion w, x, y, z (4) and gap (1), shape [batch, T, manipulator, 8].
        mass: Mass tensors, shape [batch, T, n, n, n]; empty if not requested.
    """

    x: torch.Tensor
    v: torch.Tensor
    poses: torch.Tensor
    mass: torch.Tensor


@torch._disable_dynamo
def simulate(
    simulator: Simulator,
    actions: torch.Tensor,
    *,
    every_step: bool = True,
    mass: bool = True,
    material: torch.Tensor | None = None,
    **initial: torch.Tensor,
) -> States:
    """Simulate actions and return the states, for arbitrary differentiable PyTorch functions of them.

    Gradients are propagated to actions, initial state and material. The contact model is the simulator's; its
    loss terms are not used. Call ``backward`` before the simulator is used again. Derivatives with respect to
    quaternions are those of the rotation matrix as a polynomial.

    Args:
        simulator: The simulator; it needs ``full_gradient=True`` if initial state or material require
            gradients.
        actions: Actions, shape [batch, T, A], on any device; integers become floating-point numbers of the
            simulator's precision.
        every_step: Whether to return the state after every environment step instead of only the last one.
        mass: Whether to return mass tensors, too.
        material: Parameters, see :attr:`plab.sim.Simulator.material_keys`, shape [parameter], [batch,
            parameter] or, if bodies have their own materials, [batch, body, parameter]; default: unchanged.
        **initial: Parts of the initial state, by the fields of :class:`plab.sim.State`. Like the material,
            they are stored in the simulator.

    Returns:
        The states, like ``actions`` in type and device.

    Raises:
        TypeError: If ``initial`` has unknown names, or the actions are complex.
        plab.scenes.SceneError: If the material cannot be simulated.
        RuntimeError: If a gradient is requested after the simulator has been used again, or requires
            ``full_gradient=True``; other errors are those of :meth:`plab.sim.Simulator.record`.
    """
    if unknown := set(initial) - set(_FIELDS):
        raise TypeError(f"'{min(unknown)}' is not a part of a state: {', '.join(_FIELDS)}")
    given = [material, *(initial.get(name) for name in _FIELDS)]
    # Arrays are accepted, too, and a number as the first parameter of the material.
    tensors = [part if part is None else torch.atleast_1d(torch.as_tensor(part)) for part in given]
    parts = [floating(actions, simulator), *tensors]
    gradient = torch.is_grad_enabled() and any(part is not None and part.requires_grad for part in parts)
    return States(*_States.apply(simulator, every_step, mass, gradient, *parts))


_FIELDS = ("x", "v", "C", "F", "poses")


class _States(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        simulator: Simulator,
        every_step: bool,
        mass: bool,
        gradient: bool,
        actions: torch.Tensor,
        material: torch.Tensor | None,
        *initial: torch.Tensor | None,
    ) -> tuple[torch.Tensor, ...]:
        if material is not None:
            simulator.set_material(*material.detach().cpu().double().unbind(-1))
        given = zip(_FIELDS, initial, strict=True)
        parts = {name: part.detach().cpu().double().numpy() for name, part in given if part is not None}
        if parts:
            simulator.reset()
            simulator.set_initial_state(replace(simulator.state(), **parts))
        moves = simulator_input(actions, simulator)
        recording = simulator.record(moves, every_step=every_step, mass=mass, gradient=gradient)
        ctx.simulator, ctx.recording = simulator, recording
        ctx.likes = actions, material, *initial
        ctx.set_materialize_grads(False)
        shown = recording.x, recording.v, recording.poses, recording.mass if mass else np.zeros(0)
        return tuple(torch.as_tensor(part).to(actions, copy=True) for part in shown)

    @staticmethod
    def backward(ctx: Any, *bars: torch.Tensor | None) -> tuple[Any, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("simulate has no second derivatives: omit create_graph=True")
        recording: RecordedStates = ctx.recording
        held = {
            name: simulator_input(bar, ctx.simulator)
            for name, bar in zip(States._fields, bars, strict=True)
            if bar is not None and bar.numel()
        }
        actions, material, *initial = ctx.likes
        gradients: list[torch.Tensor | None] = [torch.as_tensor(recording.pullback(**held)).to(actions), None]
        if ctx.needs_input_grad[5]:
            by_material = ctx.simulator.material_gradient()
            # One for all environments or bodies.
            shared = tuple(range(material.ndim - 1, by_material.ndim - 1))
            by_material = by_material.sum(axis=shared)[..., : material.shape[-1]]
            gradients[1] = torch.as_tensor(by_material).to(material)
        wanted = ctx.needs_input_grad[6:]
        state: State | None = ctx.simulator.state_gradient() if any(wanted) else None
        for name, like, asked in zip(_FIELDS, initial, wanted, strict=True):
            gradients.append(torch.as_tensor(getattr(state, name)).to(like) if asked else None)
        return None, None, None, None, *gradients


class PolicySteps(NamedTuple):
    """Some steps of a policy in a batch of episodes.

    Attributes:
        observations: Observations before each step and after the last, shape [T + 1, batch, entry].
        actions: Shape [T, batch, A].
        terms: Unweighted loss terms after each step, shape [T, batch, term].
        loss: Weighted step losses, shape [T, batch].
    """

    observations: torch.Tensor
    actions: torch.Tensor
    terms: torch.Tensor
    loss: torch.Tensor


def policy_gradient(
    batch: EpisodeBatch,
    policy: Callable[[torch.Tensor], torch.Tensor],
    steps: int,
    *,
    parameters: Iterable[torch.Tensor] | None = None,
    discount: float = 1.0,
    value: Callable[[torch.Tensor], torch.Tensor] | None = None,
) -> PolicySteps:
    """Run a policy from the current states of a batch of episodes, and add the gradient of its loss to the
    ``grad`` of its parameters.

    The loss is the mean over the environments of the discounted step losses, less the discounted value of the
    last observation. The gradient is complete: it includes the simulated states and the effect of each action
    on later observations, and thereby on later actions. A policy may be stochastic, with reparameterised
    samples (``rsample``).

    Args:
        batch: Episodes after :meth:`~plab.envs.core.EpisodeBatch.reset`; they advance by the steps.
        policy: Function from observations, shape [batch, entry], to actions, shape [batch, A], clipped to
            [-1, 1]; on the simulator's device. Observations have the type of its parameters.
        steps: Steps T.
        parameters: Parameters of the policy; default: the parameters of the module.
        discount: Discount factor: the loss of step t is weighted by ``discount ** t``, the value by
            ``discount ** T``.
        value: Function from observations to values, shape [batch]; its parameters receive no gradient.

    Returns:
        Observations, actions and losses, without gradients; errors are those of
        :meth:`plab.envs.core.EpisodeBatch.closed_loop`.
    """
    own = getattr(policy, "parameters", list)() if parameters is None else parameters
    parameters = [one for one in own if one.requires_grad]
    if not parameters:
        raise ArgumentError("the policy has no parameters with gradients: pass a module, or parameters=...")
    like = parameters[0].detach()
    seen: list[torch.Tensor] = []
    done: list[torch.Tensor] = []
    given = functools.partial(simulator_input, simulator=batch.problem.simulator)

    def choose(t: int, observation: Any) -> Any:
        seen.append(torch.as_tensor(observation).to(like).requires_grad_())
        if t == steps:
            return None
        with torch.enable_grad():
            done.append(policy(seen[t]))
        return given(done[t])

    def react(t: int, actions_bar: Any) -> Any:
        """Add to the gradients of the parameters; return the derivative with respect to the observation."""
        if t == steps:
            if value is None:
                return None
            with torch.enable_grad():
                worth = value(seen[-1]).sum()
            return given(torch.autograd.grad(-(discount**steps) * worth, seen[-1])[0])
        bar = torch.as_tensor(actions_bar).to(like)
        seen_bar, *by_parameter = torch.autograd.grad(done[t], [seen[t], *parameters], bar, allow_unused=True)
        for parameter, part in zip(parameters, by_parameter, strict=True):
            if part is not None:
                part = part / batch.size
                parameter.grad = part if parameter.grad is None else parameter.grad + part
        return None if seen_bar is None else given(seen_bar)

    terms = batch.closed_loop(steps, choose, react, discount=discount, like=like if like.is_cuda else None)
    loss = batch.problem.loss_of(terms)
    shown = [torch.as_tensor(array).to(like).transpose(0, 1) for array in (terms, loss)]
    return PolicySteps(torch.stack(seen).detach(), torch.stack(done).detach(), *shown)
