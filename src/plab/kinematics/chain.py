"""Kinematic trees of joints, with limits, and links, as plain data and NumPy arrays."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import PlabError
from plab.plugins import scipy

Matrix = tuple[tuple[float, ...], ...]
"""Homogeneous transform, 4 rows of 4 numbers."""

BASE_JOINTS = {
    "base_x": (1.0, 0.0, 0.0),
    "base_y": (0.0, 1.0, 0.0),
    "base_z": (0.0, 0.0, 1.0),
    "base_yaw": (0.0, 1.0, 0.0),
    "base_pitch": (1.0, 0.0, 0.0),
    "base_roll": (0.0, 0.0, 1.0),
}
"""Axes of the joints of a free base: three slides along the world's axes, then three hinges."""


class ModelError(PlabError, ValueError):
    """Unreadable or unsupported model; the one-line message names it."""


@dataclass(frozen=True)
class Joint:
    """A joint and its transform relative to the parent frame: first ``offset``, then the joint's motion.

    Attributes:
        name: Name.
        parent: Index of the parent joint, -1 for the world.
        offset: Transform from the joint frame at position 0 to the parent's frame.
        hinge: Whether the joint rotates about the axis instead of sliding along it.
        axis: Unit vector in the joint frame.
        anchor: A point on a hinge's axis, in the joint frame [domain units].
        low: Lowest position [rad or domain units].
        high: Highest position.
        scale: Motion per environment step at action 1.
        start: Position at t = 0.
        component: Index of the action component that moves the joint.
    """

    name: str
    parent: int
    offset: Matrix
    hinge: bool
    axis: tuple[float, ...]
    anchor: tuple[float, ...] = (0.0, 0.0, 0.0)
    low: float = -math.inf
    high: float = math.inf
    scale: float = 0.0
    start: float = 0.0
    component: int = 0

    def motion(self) -> np.ndarray:
        """Matrices M, shape [4, 4, 4], of the transform from the joint frame to the parent's, at position q:
        M[0] + sin(q) M[1] + (1 - cos(q)) M[2] + q M[3]."""
        parts, (x, y, z) = np.zeros((4, 4, 4)), self.axis
        parts[0] = np.eye(4)
        if self.hinge:
            # Rodrigues' formula about the anchor.
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            for part, turn in zip(parts[1:3], (cross, cross @ cross), strict=True):
                part[:3] = np.column_stack([turn, -turn @ self.anchor])
        else:
            parts[3, :3, 3] = self.axis
        return np.array(self.offset) @ parts

    def matrix(self, position: float) -> np.ndarray:
        """Transform from the joint frame to the parent's, shape [4, 4]."""
        factors = (1.0, math.sin(position), 1.0 - math.cos(position), position)
        return np.tensordot(factors, self.motion(), 1)


@dataclass(frozen=True)
class Link:
    """A rigid link.

    Attributes:
        parent: Index of the joint that the link is attached to, -1 for the world.
        offset: Transform from the link frame, in which its shape is defined, to the joint frame.
        shape: Key of :data:`plab.scenes.MANIPULATOR_SHAPES`, with the motion ``twist``.
        size: Lengths of the shape [domain units].
    """

    parent: int
    offset: Matrix
    shape: str
    size: tuple[float, ...]


Node = TypeVar("Node", Joint, Link)


@dataclass(frozen=True)
class Chain:
    """A kinematic tree in a scene.

    Attributes:
        joints: Joints; a parent comes before its children.
        links: Links, in the order of the scene's last manipulators.
        components: Names of the action components; each is clipped to [-1, 1].
    """

    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    components: tuple[str, ...] = ()

    @property
    def topology(self) -> tuple[object, ...]:
        """Structure that all scenes of a simulator must share."""
        joints = tuple((joint.parent, joint.hinge, joint.component) for joint in self.joints)
        return joints, tuple((link.parent, link.shape) for link in self.links)

    def frames(self, positions: Sequence[float]) -> np.ndarray:
        """Transforms from links to the world, shape [link, 4, 4], for joint positions, shape [joint]."""
        world = {-1: np.eye(4)}
        for number, (joint, position) in enumerate(zip(self.joints, positions, strict=True)):
            world[number] = world[joint.parent] @ joint.matrix(position)
        return np.array([world[link.parent] @ np.array(link.offset) for link in self.links])

    def largest_step(self) -> float:
        """Upper bound of the displacement of any point of a link in an environment step [domain units]."""
        most = 0.0
        for link in self.links:
            reach = float(np.linalg.norm(np.array(link.offset)[:3, 3])) + sum(link.size)
            way, number = 0.0, link.parent
            while number >= 0:
                joint = self.joints[number]
                arm = float(np.linalg.norm(joint.anchor))
                way += joint.scale * (reach + arm if joint.hinge else 1.0)
                moved = 2.0 * arm if joint.hinge else min(max(abs(joint.low), abs(joint.high)), 1.0)
                reach += float(np.linalg.norm(np.array(joint.offset)[:3, 3])) + moved
                number = joint.parent
            most = max(most, way)
        return most

    def placed(
        self,
        position: Sequence[float],
        rotation: Sequence[float],
        free: bool,
        *,
        scale: Mapping[str, float],
        start: Mapping[str, float],
        limits: Mapping[str, Sequence[float]],
        together: Mapping[str, str],
    ) -> Chain:
        """Place a model in a scene, and select the joints that move.

        Args:
            position: Origin of the model [domain units].
            rotation: Quaternion w, x, y, z from the model's axes to the world's.
            free: Whether the base can move, by :data:`BASE_JOINTS`.
            scale: Motion per environment step at action 1, by patterns of joint names; the last match
                applies. Joints without a scale are fixed.
            start: Positions at t = 0, by patterns.
            limits: Lowest and highest positions, likewise; default: the model's.
            together: Patterns of joints that share one action component, by the component's name.

        Raises:
            ModelError: If a pattern matches no joint, limits are not in order, an initial position is outside
                them, or no joint can move.
        """
        turn = pose_matrix((0.0, 0.0, 0.0), rotation)
        place = pose_matrix(position, (1.0, 0.0, 0.0, 0.0))
        base: list[Joint] = []
        for k, (name, axis) in enumerate(BASE_JOINTS.items() if free else ()):
            most = math.pi if k >= 3 else 1.0
            offset = _tuples(np.eye(4) if k else place)
            base.append(Joint(name, k - 1, offset, k >= 3, axis, low=-most, high=most))
        first = turn if base else place @ turn
        shift = len(base)

        def moved(node: Node) -> Node:
            if node.parent >= 0:
                return replace(node, parent=node.parent + shift)
            return replace(node, parent=shift - 1, offset=_tuples(first @ np.array(node.offset)))

        joints = base + [moved(joint) for joint in self.joints]
        names = [joint.name for joint in joints]
        scales, starts = matched("scale", scale, names), matched("start", start, names)
        bounds = matched("limits", limits, names)
        shared = {name: word for word in together for name in matched("together", {together[word]: 1}, names)}
        for k, joint in enumerate(joints):
            low, high = bounds.get(joint.name, (joint.low, joint.high))
            if low > high:
                raise ModelError(f"limits: joint {joint.name} has {low:g} .. {high:g}, not lowest, highest")
            at = starts.get(joint.name, float(np.clip(0.0, low, high)))
            if not low <= at <= high:
                raise ModelError(
                    f"start: joint {joint.name} at {at:g} is outside its limits {low:g} .. {high:g}"
                )
            joints[k] = replace(joint, low=low, high=high, start=at, scale=scales.get(joint.name, 0.0))
        chain = Chain(tuple(joints), tuple(map(moved, self.links))).moving()
        names = [shared.get(joint.name, joint.name) for joint in chain.joints]
        components = tuple(dict.fromkeys(names))
        if not components:
            raise ModelError("scale: no joint moves; set the scale of at least one joint")
        pairs = zip(chain.joints, names, strict=True)
        numbered = tuple(replace(joint, component=components.index(name)) for joint, name in pairs)
        return replace(chain, joints=numbered, components=components)

    def moving(self) -> Chain:
        """Copy of the chain without fixed joints."""
        kept: list[Joint] = []
        # For each joint: index of its new parent joint, and transform to its frame.
        frames = {-1: (-1, np.eye(4))}

        def attached(node: Node) -> Node:
            parent, matrix = frames[node.parent]
            return replace(node, parent=parent, offset=_tuples(matrix @ np.array(node.offset)))

        for number, joint in enumerate(self.joints):
            moved = attached(joint)
            if joint.scale:
                kept.append(moved)
                frames[number] = len(kept) - 1, np.eye(4)
            else:
                frames[number] = moved.parent, moved.matrix(joint.start)
        return replace(self, joints=tuple(kept), links=tuple(map(attached, self.links)))


def matched(key: str, table: Mapping[str, object], names: Sequence[str]) -> dict[str, Any]:
    """Return values by name from a table of patterns, which are regular expressions for whole names; raise
    ModelError, with a message that begins with ``key``, if a pattern matches no name."""
    found: dict[str, Any] = {}
    for pattern, value in table.items():
        try:
            hits = [name for name in names if re.fullmatch(pattern, name)]
        except re.error as error:
            raise ModelError(f"{key}: '{pattern}' is not a pattern: {error}") from None
        if not hits:
            raise ModelError(f"{key}: '{pattern}' matches none of {', '.join(names)}")
        found |= dict.fromkeys(hits, value)
    return found


def pose_matrix(position: ArrayLike, rotation: ArrayLike) -> np.ndarray:
    """Homogeneous transform, shape [4, 4], of a position and a quaternion w, x, y, z."""
    matrix = np.eye(4)
    matrix[:3, :3] = scipy.spatial.transform.Rotation.from_quat(rotation, scalar_first=True).as_matrix()
    matrix[:3, 3] = position
    return matrix


def _tuples(matrix: np.ndarray) -> Matrix:
    return tuple(map(tuple, np.asarray(matrix).tolist()))
