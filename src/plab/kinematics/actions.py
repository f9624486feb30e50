"""Conversion of joint-space actions to twists of the links of a chain, and the adjoint, in PyTorch.

In an environment step every joint moves by its share of the action, within its limits. Forward kinematics
gives the frames of the links before and after; a link's twist is its displacement and the logarithm of its
relative rotation, so that its final pose is exact. On the CPU, results are bitwise independent of the number
of environments, because products of small matrices and sums over one dimension are computed in order.
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

__all__ = ["JointActions", "LinkMotion", "rotation_vector"]


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
        self._arrays = {
            name: np.array([[getattr(joint, name) for joint in chain.joints] for chain in chains], float)
            for name in ("low", "high", "scale", "start")
        }
        self.start = self._arrays["start"]
        motions = np.array([[chain.joints[j].motion() for j in order] for chain in chains])
        self._arrays["motions"] = motions.reshape(*motions.shape[:2], 4, 16)
        self._arrays["links"] = np.array([[link.offset for link in chain.links] for chain in chains])
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
            moves = given[..., self._direct :].clamp(-1.0, 1.0).index_select(-1, c["component"]) * c["scale"]
            at = [before]
            for move in moves:
                at.append((at[-1] + move).clamp(c["low"], c["high"]))
            frames = self.frames(torch.stack(at))
            turned = rotation_vector(frames[1:, ..., :3, :3] @ frames[:-1, ..., :3, :3].mT)
            twists = torch.cat([frames[1:, ..., :3, 3] - frames[:-1, ..., :3, 3], turned], dim=-1)
            raw = torch.cat([given[..., : self._direct], twists.flatten(2)], dim=-1)
        return LinkMotion([given, before], [raw, at[-1]], not isinstance(actions, Tensor))

    def frames(self, joints: Tensor) -> Tensor:
        """Transforms from the links' frames to the world, shape [T, batch, link, 4, 4], given joint
        positions, shape [T, batch, joint]."""
        c = self._on(joints.device)
        positions = joints.index_select(-1, c["order"])
        factors = torch.stack(
            [torch.ones_like(positions), positions.sin(), 1.0 - positions.cos(), positions], dim=-1
        )
        own = (factors.unsqueeze(-2) @ c["motions"]).reshape(*positions.shape, 4, 4).split(self._sizes, dim=2)
        world = [own[0]]
        for k, frames in enumerate(own[1:]):
            world.append(world[-1].index_select(2, c[f"parents{k}"]) @ frames)
        still = c["eye"].expand(*joints.shape[:2], 1, 4, 4)
        return torch.cat([still, *world], dim=2).index_select(2, c["carriers"]) @ c["links"]

    def _on(self, device: torch.device) -> dict[str, Tensor]:
        """Chain constants on a device."""
        if device not in self._constants:
            c = {name: torch.tensor(array, device=device) for name, array in self._arrays.items()}
            c["eye"] = torch.eye(4, dtype=torch.float64, device=device)
            c |= {name: torch.tensor(index, device=device) for name, index in self._indices.items()}
            self._constants[device] = c
        return self._constants[device]


def rotation_vector(turn: Tensor) -> Tensor:
    """Logarithm, shape [..., 3], of rotation matrices, shape [..., 3, 3], with angles below pi."""
    skew = 0.5 * (turn - turn.transpose(-1, -2))
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    square = axis[..., 0] ** 2 + axis[..., 1] ** 2 + axis[..., 2] ** 2
    cosine = 0.5 * (turn[..., 0, 0] + turn[..., 1, 1] + turn[..., 2, 2] - 1.0)
    small = (square < 1e-8) & (cosine > 0.0)
    sine = torch.where(small, 1.0, square).sqrt()
    # angle / sin(angle), as a series in sin(angle)^2 near 0. Not by atan2, whose last bits depend on the
    # number of elements.
    angle = 2.0 * torch.atan(sine / (1.0 + cosine))
    ratio = torch.where(small, 1.0 + square / 6.0 + 3.0 * square**2 / 40.0, angle / sine)
    return ratio[..., None] * axis
