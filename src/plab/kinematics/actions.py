"""Conversion of joint-space actions to twists of the links of a chain, and the adjoint, in PyTorch.

In an environment step every joint moves by its share of the action, within its limits. Forward kinematics
gives the frames of the links before and after; a link's twist is its displacement and the logarithm of its
relative rotation, so that its final pose is exact. Steps and environments are the last dimensions, because
products of many small matrices are slow. Results are bitwise independent of their number, and the same in
every run, because operations are elementwise or sums over another dimension, and no gradient needs atomics.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from plab.kinematics.chain import Chain
    from plab.scenes import Scene


class LinkMotion:
    """Motion of the links in some environment steps, with its pullback.

    Attributes:
        twists: Actions of the simulator, shape [T, batch, component]: an array if computed on the CPU from an
            array, otherwise a tensor.
        joints: Joint positions after the last step, shape [batch, joint], likewise.
    """

    def __init__(self, given: list[Tensor], made: list[Tensor], as_array: bool) -> None:
        """Store ``given`` actions and joint positions, and ``made`` twists and joint positions."""
        self._given, self._made, self._as_array = given, made, as_array
        self.twists, self.joints = map(self._out, made)

    def pull_back(self, bar: Any, joints_bar: Any = None) -> tuple[Any, Any]:
        """Return the derivatives with respect to the actions, shape [T, batch, A], an array if these were
        one, and the initial joint positions, given those with respect to the twists and the final joint
        positions."""
        bars = [torch.as_tensor(bar).to(self._made[0])]
        made = self._made[:1]
        if joints_bar is not None:
            made, bars = self._made, [*bars, torch.as_tensor(joints_bar).to(self._made[1])]
        by_actions, by_joints = torch.autograd.grad(made, self._given, bars)
        return self._out(by_actions.cpu() if self._as_array else by_actions), self._out(by_joints)

    def _out(self, tensor: Tensor) -> Any:
        return tensor.detach().numpy() if self._as_array and not tensor.is_cuda else tensor.detach()


class JointActions:
    """Map from actions to twists, for a batch of scenes whose chains share one topology.

    Attributes:
        start: Joint positions at t = 0, shape [batch, joint].
    """

    def __init__(self, scenes: Sequence[Scene], device: str = "cpu") -> None:
        """Initialise with the chains of the scenes; components of other manipulators come first. Actions in
        arrays are converted on ``device``, ``cpu`` or ``cuda``, if PyTorch has it."""
        self._device = "cuda" if device == "cuda" and torch.cuda.is_available() else "cpu"
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
        self._components = [joint.component for joint in first.joints]
        self._order = order
        # Index of each joint's parent in the level above, and of each link's joint, where 0 is the world.
        self._parents = [[levels[k].index(j) for j in parents] for k, parents in enumerate(below)]
        self._carriers = [order.index(k.parent) + 1 if k.parent >= 0 else 0 for k in first.links]
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
        self._graphs: dict[torch.device, tuple[torch.cuda.CUDAGraph, list[Tensor], list[Tensor]] | None] = {}

    def drive(self, joints: Any, actions: Any, gradient: bool = True) -> LinkMotion:
        """Move the joints.

        Args:
            joints: Joint positions before the first step, shape [batch, joint].
            actions: Actions, shape [T, batch, A], float64; an array, or a tensor on any device.
            gradient: Whether :meth:`LinkMotion.pull_back` will be called.
        """
        as_array = not isinstance(actions, Tensor)
        given = torch.as_tensor(actions, device=self._device if as_array else None)
        before = torch.as_tensor(joints).detach().to(given)
        inputs = [given.requires_grad_(gradient), before.requires_grad_(gradient)]
        one = given.is_cuda and len(given) == 1 and not gradient
        with torch.set_grad_enabled(gradient):
            made = self._replayed(inputs) if one else self._moved(*inputs)
        return LinkMotion(inputs, made, as_array)

    def _moved(self, given: Tensor, before: Tensor) -> list[Tensor]:
        """Twists and final joint positions of :meth:`drive`."""
        c = self._on(given.device)
        own = given[..., self._direct :].clamp(-1.0, 1.0).permute(2, 0, 1)
        moves = _rows(own, self._components) * c["scale"][:, None]
        at = [before.T]
        for move in moves.unbind(1):
            at.append((at[-1] + move).clamp(c["low"], c["high"]))
        frames = self.frames(torch.stack(at, 1))
        twists = _twists(frames[..., :-1, :], frames[..., 1:, :]).flatten(0, 1).permute(1, 2, 0)
        return [torch.cat([given[..., : self._direct], twists], dim=-1), at[-1].T]

    def _replayed(self, inputs: list[Tensor]) -> list[Tensor]:
        """Return :meth:`_moved` for one step, from the second call on by a CUDA graph, because launching its
        many small kernels takes longer than a step."""
        device = inputs[0].device
        if device not in self._graphs:
            # The kernels must have been loaded before they are recorded.
            self._graphs[device] = None
            return self._moved(*inputs)
        if (recorded := self._graphs[device]) is None:
            graph, own = torch.cuda.CUDAGraph(), [tensor.clone() for tensor in inputs]
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                made = self._moved(*own)
            recorded = self._graphs[device] = (graph, own, made)
        graph, own, made = recorded
        for kept, tensor in zip(own, inputs, strict=True):
            kept.copy_(tensor)
        graph.replay()
        return [tensor.clone() for tensor in made]

    def frames(self, joints: Tensor) -> Tensor:
        """Transforms from the links' frames to the world, shape [link, 4, 4, T, batch], given joint
        positions, shape [joint, T, batch]."""
        c = self._on(joints.device)
        at = _rows(joints, self._order)[:, None, None]
        still, sine, cosine, slide = c["motions"].unbind(1)
        moved = still + at.sin() * sine + (1.0 - at.cos()) * cosine + at * slide
        own = moved.split(self._sizes)
        world = [own[0]]
        for parents, frames in zip(self._parents, own[1:], strict=True):
            world.append(_Product.apply(_rows(world[-1], parents), frames))
        carriers = torch.cat([c["still"].expand(1, *own[0].shape[1:]), *world])
        return _Product.apply(_rows(carriers, self._carriers), c["offsets"])

    def _on(self, device: torch.device) -> dict[str, Tensor]:
        """Chain constants on a device."""
        if device not in self._constants:
            self._constants[device] = {
                name: torch.tensor(array, device=device) for name, array in self._arrays.items()
            }
        return self._constants[device]


def _rows(tensor: Tensor, numbers: Sequence[int]) -> Tensor:
    """Rows of a tensor. Their adjoints are added without atomics, which indexing uses on CUDA."""
    rows = tensor.unbind()
    return torch.stack([rows[number] for number in numbers])


class _Product(torch.autograd.Function):
    """Products of matrices, shape [N, n, n, T, batch]."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        ctx.save_for_backward(first, second)
        return _product(first, second)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, Tensor | None]:
        first, second = ctx.saved_tensors
        by_second = _product(first.transpose(1, 2), bar) if ctx.needs_input_grad[1] else None
        return _product(bar, second.transpose(1, 2)), by_second


def _product(first: Tensor, second: Tensor) -> Tensor:
    # Not sum(), whose order of additions on CUDA depends on the shape.
    return reduce(Tensor.add, (first.unsqueeze(3) * second.unsqueeze(1)).unbind(2))


def _twists(old: Tensor, new: Tensor) -> Tensor:
    """Twists, displacement [domain units] and rotation vector [rad], shape [N, 6, T, batch], from old to new
    frames, shape [N, 4, 4, T, batch], turned by less than pi."""
    # Relative rotation and its logarithm.
    turn = _Product.apply(new[:, :3, :3], old[:, :3, :3].transpose(1, 2)).unbind(1)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(1) for row in turn)
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    square = x**2 + y**2 + z**2
    cosine = 0.5 * (xx + yy + zz - 1.0)
    small = (square < 1e-8) & (cosine > 0.0)
    sine = square.masked_fill(small, 1.0).sqrt()
    # angle / sin(angle), as a series in sin(angle)^2 near 0. Not by atan2, whose last bits depend on the
    # number of elements.
    angle = 2.0 * torch.atan(sine / (1.0 + cosine))
    ratio = torch.where(small, 1.0 + square / 6.0 + 3.0 * square**2 / 40.0, angle / sine)
    rotation = torch.stack([ratio * x, ratio * y, ratio * z], dim=1)
    return torch.cat([new[:, :3, 3] - old[:, :3, 3], rotation], dim=1)
