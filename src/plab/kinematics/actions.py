"""Conversion of joint-space actions to twists of the links of a chain, and the adjoint, in PyTorch.

In an environment step every joint moves by its share of the action, within its limits. Forward kinematics
gives the frames of the links before and after; a link's twist is its displacement and the logarithm of its
relative rotation, so that its final pose is exact. Steps and environments are the last dimensions, because
products of many small matrices are slow. On the CPU, results are bitwise independent of their number, because
operations are elementwise, or sums over another dimension.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from plab.kinematics.chain import Chain
    from plab.scenes import Scene

__all__ = ["JointActions", "LinkMotion"]


class LinkMotion:
    """Motion of the links in some environment steps, with its pullback.

    Attributes:
        twists: Actions of the simulator, shape [T, batch, component], as an array or a tensor like the
            actions.
        joints: Joint positions after the last step, shape [batch, joint], likewise.
    """

    def __init__(self, given: list[Tensor], made: list[Tensor], as_array: bool) -> None:
        """Store ``given`` actions and joint positions, and ``made`` twists and joint positions."""
        self._given, self._made, self._as_array = given, made, as_array
        self.twists, self.joints = map(self._out, made)

    def pull_back(self, bar: Any, joints_bar: Any = None) -> tuple[Any, Any]:
        """Return the derivatives with respect to the actions, shape [T, batch, A], and the initial joint
        positions, given those with respect to the twists and the final joint positions."""
        bars = [torch.as_tensor(bar).to(self._made[0])]
        made = self._made[:1]
        if joints_bar is not None:
            made, bars = self._made, [*bars, torch.as_tensor(joints_bar).to(self._made[1])]
        by_actions, by_joints = torch.autograd.grad(made, self._given, bars)
        return self._out(by_actions), self._out(by_joints)

    def _out(self, tensor: Tensor) -> Any:
        return tensor.detach().numpy() if self._as_array else tensor.detach()


class JointActions:
    """Map from actions to twists, for a batch of scenes whose chains share one topology.

    Attributes:
        start: Joint positions at t = 0, shape [batch, joint].
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Initialise with the chains of the scenes; components of other manipulators come first."""
        chains: list[Chain] = [scene.kinematics for scene in scenes]  # type: ignore[misc]
        first = chains[0]
        self._direct = scenes[0].action_dim - len(first.components)
        # Joints by depth in the tree; each depth is computed at once.
        depth: list[int] = []
        for joint in first.joints:
            depth.append(depth[joint.parent] + 1 if joint.parent >= 0 else 0)
        levels = [[j for j, d in enumerate(depth) if d == k] for k in range(max(depth) + 1)]
        order = [j for level in levels for j in level]
        self._sizes = [len(level) for level in levels]
        below = [[first.joints[j].parent for j in level] for level in levels[1:]]
        self._indices = {
            "component": [joint.component for joint in first.joints],
            "order": order,
            # Frame 0 is the world frame.
            "carriers": [order.index(k.parent) + 1 if k.parent >= 0 else 0 for k in first.links],
            **{f"parents{k}": [levels[k].index(j) for j in parents] for k, parents in enumerate(below)},
        }
        # Environments are the last dimension; the one before it is the step.
        self._arrays = {
            name: np.array([[getattr(joint, name) for joint in chain.joints] for chain in chains], float).T
            for name in ("low", "high", "scale")
        }
        motions = np.array([[chain.joints[j].motion() for j in order] for chain in chains])
        offsets = np.array([[link.offset for link in chain.links] for chain in chains])
        for name, values in {"motions": motions, "offsets": offsets}.items():
            self._arrays[name] = np.moveaxis(values, 0, -1)[..., None, :].copy()
        self._arrays["still"] = np.eye(4)[None, ..., None, None]
        self.start = np.array([[joint.start for joint in chain.joints] for chain in chains])
        self._constants: dict[torch.device, dict[str, Tensor]] = {}

    def drive(self, joints: Any, actions: Any, gradient: bool = True) -> LinkMotion:
        """Move the joints.

        Args:
            joints: Joint positions before the first step, shape [batch, joint].
            actions: Actions, shape [T, batch, A], float64; an array, or a tensor on any device.
            gradient: Whether :meth:`LinkMotion.pull_back` will be called.
        """
        given = torch.as_tensor(actions).requires_grad_()
        before = torch.as_tensor(joints).detach().to(given).requires_grad_()
        with torch.set_grad_enabled(gradient):
            c = self._on(given.device)
            own = given[..., self._direct :].clamp(-1.0, 1.0).permute(2, 0, 1)
            moves = own.index_select(0, c["component"]) * c["scale"][:, None]
            at = [before.T]
            for move in moves.unbind(1):
                at.append((at[-1] + move).clamp(c["low"], c["high"]))
            frames = self.frames(torch.stack(at, 1))
            twists = _twists(frames[..., :-1, :], frames[..., 1:, :]).flatten(0, 1).permute(1, 2, 0)
            raw = torch.cat([given[..., : self._direct], twists], dim=-1)
        return LinkMotion([given, before], [raw, at[-1].T], not isinstance(actions, Tensor))

    def frames(self, joints: Tensor) -> Tensor:
        """Transforms from the links' frames to the world, shape [link, 4, 4, T, batch], given joint
        positions, shape [joint, T, batch]."""
        c = self._on(joints.device)
        at = joints.index_select(0, c["order"])[:, None, None]
        still, sine, cosine, slide = c["motions"].unbind(1)
        moved = still + at.sin() * sine + (1.0 - at.cos()) * cosine + at * slide
        own = moved.split(self._sizes)
        world = [own[0]]
        for k, frames in enumerate(own[1:]):
            world.append(_product(world[-1].index_select(0, c[f"parents{k}"]), frames))
        carriers = torch.cat([c["still"].expand(1, *own[0].shape[1:]), *world])
        return _product(carriers.index_select(0, c["carriers"]), c["offsets"])

    def _on(self, device: torch.device) -> dict[str, Tensor]:
        """Chain constants on a device."""
        if device not in self._constants:
            c = {name: torch.tensor(array, device=device) for name, array in self._arrays.items()}
            c |= {name: torch.tensor(index, device=device) for name, index in self._indices.items()}
            self._constants[device] = c
        return self._constants[device]


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Products of matrices, shape [N, 4, 4, T, batch]."""
    return (first.unsqueeze(3) * second.unsqueeze(1)).sum(2)


def _twists(old: Tensor, new: Tensor) -> Tensor:
    """Twists, displacement [domain units] and rotation vector [rad], shape [N, 6, T, batch], from old to new
    frames, shape [N, 4, 4, T, batch], turned by less than pi."""
    # Relative rotation and its logarithm.
    turn = (new[:, :3, None, :3] * old[:, None, :3, :3]).sum(3)
    skew = 0.5 * (turn - turn.transpose(1, 2))
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1)
    square = axis[:, 0] ** 2 + axis[:, 1] ** 2 + axis[:, 2] ** 2
    cosine = 0.5 * (turn[:, 0, 0] + turn[:, 1, 1] + turn[:, 2, 2] - 1.0)
    small = (square < 1e-8) & (cosine > 0.0)
    sine = torch.where(small, 1.0, square).sqrt()
    # angle / sin(angle), as a series in sin(angle)^2 near 0. Not by atan2, whose last bits depend on the
    # number of elements.
    angle = 2.0 * torch.atan(sine / (1.0 + cosine))
    ratio = torch.where(small, 1.0 + square / 6.0 + 3.0 * square**2 / 40.0, angle / sine)
    return torch.cat([new[:, :3, 3] - old[:, :3, 3], ratio[:, None] * axis], dim=1)
