"""Contact starts: initial action sequences that move manipulators to contact points, derived from the
required transport of mass.

Points of the body are assigned to points of the target by optimal transport. A start either pushes, with each
manipulator behind one of the points and along its displacement, or carries: each manipulator moves to the
nearest body, presses, and follows the body's mean displacement. Only the mass tensor of the target is used.
Paths are straight, so obstacles may be hit; with several bodies, some paths lead over them. Bodies without a
manipulator nearby are assumed to stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from plab.plugins import scipy
from plab.scenes import ROLL_RADIUS, Manipulator, Scene, sample_particles
from plab.targets.scripted import ActionTrack

POINTS = 256
"""Number of points of the body and of the target."""

ALIGNMENTS = 10
"""Number of assignments for several bodies; each moves the bodies by their mean displacements."""

TUBE = 0.04
"""Half width of the swept path in which a manipulator is assumed to make contact [domain units]."""

PRESS_DEPTH = (0.0, 0.03)
"""Range of the depth to which manipulators press into a body before carrying it [domain units]."""

ARCH = (0.0, 0.15)
"""Range of the height to which half of the carried bodies are lifted first [domain units]."""

UNREACHED_COST = 100.0
"""Weight of the squared distance to the target for points of a body without a manipulator nearby."""

OVERSHOOT = (0.5, 1.5)
"""Range of the pushing distance, relative to the displacement of the pushed point."""

REACH = (0.3, 1.0)
"""Range of the displacement of an articulated model's base, relative to the way of a link to a point."""


class ContactStarts:
    """Initial action sequences for a scene and its target.

    Attributes:
        scene: The scene.
    """

    def __init__(self, scene: Scene, target: np.ndarray) -> None:
        """Store the scene and the target's mass tensor, shape [n, n, n]."""
        self.scene, self._target = scene, target
        self._tools = [m for m in scene.tools if m.action_dim]

    def draw(self, count: int, seed: int) -> np.ndarray:
        """Sample starts, alternately pushing and carrying: actions in [-1, 1], shape [count, T, A]."""
        rng = np.random.default_rng(seed)
        return np.stack(
            [self._with_joints((self._carry if k % 2 else self._push)(rng), rng) for k in range(count)]
        )

    def _with_joints(self, own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Append the actions of the articulated model, if any: two uniform motions.

        A movable base first moves a random link towards a random point of a body, then follows the mean
        displacement of the bodies. The other joints move by a random common amount, as in closing a hand,
        plus individual ones.
        """
        chain, steps = self.scene.kinematics, self.scene.horizon
        if chain is None:
            return own
        first = max(1, int(steps * rng.uniform(0.3, 0.6)))
        count = len(chain.components)
        rows = rng.uniform(-1.0, 1.0, (2, 1)) + rng.uniform(-1.0, 1.0, (2, count)) * rng.uniform(size=(2, 1))
        rows *= rng.uniform(size=(2, 1)) ** 2
        points, ways, _ = self._transport
        links = chain.frames([joint.start for joint in chain.joints])[:, :3, 3]
        reach = rng.choice(points) - rng.choice(links)
        motions = (rng.uniform(*REACH) * reach / first, np.median(ways, axis=0) / (steps - first or 1))
        for joint in chain.joints:
            if joint.name in ("base_x", "base_y", "base_z"):
                axis = "xyz".index(joint.name[-1])
                rows[:, joint.component] = [way[axis] / joint.scale for way in motions]
        moved = np.repeat(rows, [first, steps - first], axis=0)
        return np.concatenate([own, np.clip(moved, -1.0, 1.0)], axis=1)

    @cached_property
    def _transport(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points of the bodies, shape [point, 3], their displacements, same shape, and the indices of
        their bodies."""
        scene = self.scene
        body = np.repeat(np.arange(len(scene.bodies)), [b.particles for b in scene.bodies])
        # Distributed evenly over particles and mass, so that all bodies and parts of the target are
        # represented, with at least one point per body.
        evenly = np.linspace(0, len(body), min(POINTS, len(body)), endpoint=False, dtype=int)
        chosen = np.union1d(evenly, np.unique(body, return_index=True)[1])
        points, body = sample_particles(scene)[chosen], body[chosen]
        mass = np.maximum(self._target, 0.0).ravel().cumsum()
        nodes = np.searchsorted(mass, (np.arange(len(points)) + 0.5) / len(points) * mass[-1])
        goals = np.stack(np.unravel_index(nodes, self._target.shape), axis=1) * scene.dx
        moved = np.zeros_like(points)
        held = {self._owner(tool) for tool in self._tools} or set(body.tolist())
        weight = np.where(np.isin(body, list(held)), 1.0, UNREACHED_COST)[:, None]
        for _ in range(ALIGNMENTS if len(scene.bodies) > 1 else 1):
            distances = scipy.spatial.distance.cdist(points + moved, goals, "sqeuclidean")
            _, assigned = scipy.optimize.linear_sum_assignment(weight * distances)
            ways = goals[assigned] - points
            # Bodies stay whole: the next assignment uses the residuals after each body's mean displacement.
            moved = _middle_ways(ways, body)[body]
        return points, ways, body

    def _push(self, rng: np.random.Generator) -> np.ndarray:
        points, ways, body = self._transport
        lengths = np.linalg.norm(ways, axis=1)
        tracks = []
        for tool in self._tools:
            k = rng.choice(len(points), p=lengths**2 / (lengths**2).sum())
            direction = ways[k] / lengths[k]
            track = ActionTrack(tool)
            track.go(_action(tool, self._to_touch(tool, points[body == body[k]], points[k], direction)))
            left = max(1, int((self.scene.horizon - len(track)) * rng.uniform(0.5, 1.0)))
            track.go(_action(tool, rng.uniform(*OVERSHOOT) * ways[k]), left)
            tracks.append(track)
        return self._actions(tracks)

    def _carry(self, rng: np.random.Generator) -> np.ndarray:
        points, ways, body = self._transport
        middle = _middle_ways(ways, body)
        press, tracks = rng.uniform(*PRESS_DEPTH), []
        for tool in self._tools:
            own = points[body == self._owner(tool)]
            track = ActionTrack(tool)
            if not tool.kind.grips:
                offset = own.mean(0) - np.asarray(tool.position)
                direction = offset / np.linalg.norm(offset)
                track.go(_action(tool, self._to_touch(tool, own, own.mean(0), direction) + press * direction))
            tracks.append(track)
        together = max(map(len, tracks), default=0)
        # Manipulators that hold a body between them must move at the same speed.
        left = max(2, int((self.scene.horizon - together) * rng.uniform(0.5, 1.0)))
        # Every second path leads over other bodies.
        rise = rng.uniform(*ARCH) if len(self.scene.bodies) > 1 and rng.integers(2) else 0.0
        arch = np.array([0.0, rise, 0.0])
        for track, tool in zip(tracks, self._tools, strict=True):
            half = middle[self._owner(tool)] / 2
            track.wait(together)
            track.go(_action(tool, half + arch), left // 2)
            track.go(_action(tool, half - arch), left - left // 2)
        return self._actions(tracks)

    def _owner(self, tool: Manipulator) -> int:
        """Return the index of the body with the centre nearest to a manipulator."""
        centres = np.array([body.center for body in self.scene.bodies])
        return int(np.linalg.norm(centres - np.asarray(tool.position), axis=1).argmin())

    def _to_touch(
        self, tool: Manipulator, points: np.ndarray, point: np.ndarray, direction: np.ndarray
    ) -> np.ndarray:
        """Return the displacement of a manipulator up to contact with a body, given by points, when
        approaching one of them along a direction."""
        along = (points - point) @ direction
        aside = np.linalg.norm(points - point - along[:, None] * direction, axis=1)
        met = point + along[aside < TUBE].min(initial=0.0) * direction
        # Manipulators that grip between their parts, such as chopsticks, have no extent.
        own, reach = _rotation(tool).inv().apply(direction), tool.kind.support
        extent = 0.0 if reach is None else float(reach(tool.size, own))
        place = np.clip(met - extent * direction, tool.lower_bound, tool.upper_bound)
        return place - np.asarray(tool.position)

    def _actions(self, tracks: Sequence[ActionTrack]) -> np.ndarray:
        steps = self.scene.horizon
        return np.concatenate([np.zeros((steps, 0)), *(track.first(steps) for track in tracks)], axis=1)


def _middle_ways(ways: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Return the median displacement of each body, shape [body, 3], because some of its points may be
    assigned to other bodies' targets."""
    return np.stack([np.median(ways[body == b], axis=0) for b in np.unique(body)])


def _rotation(tool: Manipulator) -> scipy.spatial.transform.Rotation:
    return scipy.spatial.transform.Rotation.from_quat(tool.rotation, scalar_first=True)


def _action(tool: Manipulator, way: np.ndarray) -> np.ndarray:
    """Return the motion of a manipulator along a displacement [3] [domain units], as far as possible without
    rotation, one entry per action component."""
    if tool.kind.motion == "roll":
        axis = _rotation(tool).apply([0.0, 1.0, 0.0])
        return np.array([(axis[0] * way[2] - axis[2] * way[0]) / ROLL_RADIUS, 0.0, way[1]])
    return np.concatenate([way, np.zeros(tool.action_dim - 3)])
