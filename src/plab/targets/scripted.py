"""Scripted target recipes: the final state of a demonstration sampled from a seed.

Each recipe samples the paths of the manipulators from the ranges in the task's YAML and converts them to
actions; the target is the final shape in the hard contact model. Such configurations are therefore solvable,
with a known solution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import located
from plab.kinematics.chain import matched
from plab.plugins import scipy
from plab.scenes import MANIPULATOR_SHAPES, MATERIAL_KEYS, ROLL_RADIUS, Body, Manipulator, Scene
from plab.targets.recipes import EPISODE_STEPS, Recipe, TargetError

DRAWS = 200
"""Maximum number of samples until a script fits into an episode."""

CLEARANCE = 0.02
"""Height at which a body is carried over another [domain units]."""

DECIMALS = 4
"""Number of decimals of actions, so that stored actions are exactly the simulated ones."""


class _TooLong(Exception):
    """Path that does not fit into an episode."""


class ActionTrack:
    """Actions of one manipulator, ``tool``, built from a sequence of motions."""

    def __init__(self, manipulator: Manipulator) -> None:
        """Start without steps at the manipulator's position."""
        self.tool = manipulator
        self._scale = np.asarray(manipulator.scale)
        self._actions: list[np.ndarray] = []

    def __len__(self) -> int:
        """Number of environment steps so far."""
        return len(self._actions)

    def go(self, way: ArrayLike, steps: int = 1) -> None:
        """Append a uniform motion, one entry per action component [domain units or radians], in the given
        number of steps, or more if the distance requires it."""
        way = np.asarray(way, dtype=float)
        # A component that cannot move has scale 0.
        share = np.divide(way, self._scale, out=np.zeros_like(way), where=self._scale > 0)
        # Slightly less, because rounding would add a step if the distance fits exactly.
        steps = max(steps, math.ceil(np.abs(share).max() - 1e-9), 1)
        self._actions += [share / steps] * steps

    def wait(self, until: int) -> None:
        """Stay at rest until the given step."""
        self._actions += [np.zeros_like(self._scale)] * (until - len(self))

    def delay(self) -> None:
        """Delay the whole motion so that it ends with the episode."""
        self._actions = [np.zeros_like(self._scale)] * (EPISODE_STEPS - len(self)) + self._actions

    def first(self, steps: int) -> np.ndarray:
        """Return the actions of the first ``steps`` steps, shape [steps, A]."""
        self.wait(steps)
        return np.clip(np.round(self._actions[:steps], DECIMALS), -1.0, 1.0)


@dataclass
class Script(Recipe):
    """A scripted demonstration of the manipulators that can move, the first of which has the rule ``motion``.

    Attributes:
        seed: Random seed, >= 0.
        youngs_modulus: Young's modulus E during the demonstration; default, as for the following keys: the
            scene's. Bodies with their own material keep it.
        poisson_ratio: Poisson ratio nu.
        yield_stress: von Mises yield stress.
    """

    seed: int
    youngs_modulus: float | None = field(default=None, kw_only=True)
    poisson_ratio: float | None = field(default=None, kw_only=True)
    yield_stress: float | None = field(default=None, kw_only=True)

    motion = "translate"

    @property
    def material(self) -> dict[str, float]:
        """Material parameters that differ from the scene's, by the names of
        :data:`plab.scenes.MATERIAL_KEYS`."""
        return {key: value for key in MATERIAL_KEYS if (value := getattr(self, key)) is not None}

    def actions(self, scene: Scene) -> np.ndarray:
        """Sample the demonstration's actions in [-1, 1], shape [EPISODE_STEPS, A]; raise TargetError if a
        parameter has an invalid value or no sampled path fits into an episode."""
        if self.seed < 0:
            raise TargetError(f"target.seed must be at least 0, not {self.seed}")
        rng, movers = np.random.default_rng(self.seed), [m for m in scene.tools if m.action_dim]
        for _ in range(DRAWS):
            try:
                return self.sample(scene, [ActionTrack(m) for m in movers], rng)
            except _TooLong:
                continue
        raise TargetError(
            f"the script does not fit into {EPISODE_STEPS} steps: make its ranges smaller or the scale larger"
        )

    def sample(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> np.ndarray:
        """Sample actions once; raise _TooLong if they do not fit into an episode."""
        fitting = [name for name, kind in MANIPULATOR_SHAPES.items() if kind.motion == self.motion]
        if not tracks or tracks[0].tool.shape not in fitting:
            raise TargetError(f"target.recipe needs {' or '.join(fitting)} as first moving manipulator")
        self.plan(scene, tracks, rng)
        if max(map(len, tracks)) > EPISODE_STEPS:
            raise _TooLong
        return np.concatenate([track.first(EPISODE_STEPS) for track in tracks], axis=1)

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        """Sample one path for each moving manipulator."""


@dataclass
class PressTarget(Script):
    """A manipulator descends onto the first body, off its centre, and rises again.

    Attributes:
        offset: Range of the distance from the body's centre, in x and in z [domain units].
        depth: Range of the depth below the body's top [domain units].
    """

    offset: list[float]
    depth: list[float]

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        track, tool = tracks[0], tracks[0].tool
        offset = np.array([_draw(rng, "offset", self.offset) for _ in range(2)])
        x, z = offset * rng.choice([-1.0, 1.0], size=2)
        depth = _draw(rng, "depth", self.depth)
        height = tool.position[1] - _extent(tool, 0.0, -1.0, 0.0) - _top(scene.bodies[0])
        track.go([x, -height, z])
        track.go([0.0, -depth, 0.0])
        track.go([0.0, (EPISODE_STEPS - len(track)) * tool.scale[1] / 2, 0.0], EPISODE_STEPS - len(track))


@dataclass
class DrawTarget(Script):
    """A pen draws connected straight strokes on the first body's top, and is lifted.

    Attributes:
        strokes: Range of the number of strokes, inclusive.
        length: Range of a stroke's length [domain units].
        margin: Minimum distance of stroke ends from the body's edges [domain units].
        depth: Range of the tip's depth below the body's top [domain units].
    """

    strokes: list[int]
    length: list[float]
    margin: float
    depth: list[float]

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        track, tool = tracks[0], tracks[0].tool
        body = scene.bodies[0]
        depth = _draw(rng, "depth", self.depth)
        track.go([0.0, _top(body) - depth - (tool.position[1] - _extent(tool, 0.0, -1.0, 0.0)), 0.0])
        at = np.asarray(tool.position)[[0, 2]]
        room = body.half_extent()[[0, 2]] - self.margin
        for _ in range(_count(rng, "strokes", self.strokes)):
            way = self._stroke(at - np.asarray(body.center)[[0, 2]], room, rng)
            track.go([way[0], 0.0, way[1]])
            at = at + way
        track.go([0.0, depth + tool.size[-1], 0.0])

    def _stroke(self, at: np.ndarray, room: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Sample a stroke [2] from a position [2] that ends within +-room [2] of the body's centre."""
        for _ in range(DRAWS):
            angle, length = rng.uniform(0, 2 * math.pi), _draw(rng, "length", self.length)
            way = length * np.array([math.cos(angle), math.sin(angle)])
            if np.all(np.abs(at + way) <= room):
                return way
        raise _TooLong


@dataclass
class DentTarget(Script):
    """A sphere pushes dents into the first body, each towards its centre.

    Attributes:
        dents: Range of the number of dents, inclusive.
        elevation: Range of the approach angle above the horizontal [rad].
        azimuth: Range of the approach angle about the vertical, from x towards z [rad].
        depth: Range of a dent's depth [domain units].
    """

    dents: list[int]
    elevation: list[float]
    azimuth: list[float]
    depth: list[float]

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        track, tool = tracks[0], tracks[0].tool
        body = scene.bodies[0]
        centre, half = np.asarray(body.center), body.half_extent()
        radius = tool.size[0]
        # Far enough to pass the body's corners.
        clear = float(np.linalg.norm(half)) + radius
        at = np.asarray(tool.position) - centre
        for _ in range(_count(rng, "dents", self.dents)):
            up, around = _draw(rng, "elevation", self.elevation), _draw(rng, "azimuth", self.azimuth)
            direction = np.array(
                [math.cos(up) * math.cos(around), math.sin(up), math.cos(up) * math.sin(around)]
            )
            for point in _arc(at, clear * direction):
                track.go(point - at)
                at = point
            touch = _touch(half, direction, radius)
            inner = (touch - _draw(rng, "depth", self.depth)) * direction
            track.go(inner - at)
            track.go(at - inner)


@dataclass
class RollTarget(Script):
    """A rolling pin moves back and forth over the first body while descending.

    Attributes:
        reach: Range of the displacement from the middle to either side [domain units].
        depth: Range of the descent over the episode [domain units].
        yaw: Range of the rotation about the vertical over the episode [rad].
    """

    reach: list[float]
    depth: list[float]
    yaw: list[float]

    motion = "roll"

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        track, tool = tracks[0], tracks[0].tool
        per_step = np.array([_draw(rng, "yaw", self.yaw), -_draw(rng, "depth", self.depth)]) / EPISODE_STEPS
        angle = _draw(rng, "reach", self.reach) / ROLL_RADIUS
        side = rng.choice([-1.0, 1.0])
        legs = [side * angle]
        while len(track) < EPISODE_STEPS:
            steps = max(math.ceil(abs(legs[-1]) / tool.scale[0] - 1e-9), 1)
            taken = min(steps, EPISODE_STEPS - len(track))
            track.go([legs[-1] * taken / steps, *(per_step * taken)], taken)
            legs.append(-2 * angle * math.copysign(1.0, legs[-1]))


@dataclass
class LiftTarget(Script):
    """Chopsticks lift the first body, move it sideways and rotate it, so that its ends hang and trail behind.

    Attributes:
        height: Range of the lift [domain units].
        turn: Range of the rotation about the vertical, to either side [rad].
        x: Range of the displacement along x, to either side [domain units].
        z: Range of the displacement along z [domain units].
    """

    height: list[float]
    turn: list[float]
    x: list[float]
    z: list[float]

    motion = "grip"

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        track = tracks[0]
        height, z = _draw(rng, "height", self.height), _draw(rng, "z", self.z)
        turn, x = _draw(rng, "turn", self.turn), _draw(rng, "x", self.x)
        sides = rng.choice([-1.0, 1.0], size=2)
        # With faster motion the body would slip.
        lift = 20
        track.go([0.0, height, 0.0, 0.0, 0.0, 0.0, 0.0], lift)
        track.go([sides[0] * x, 0.0, z, 0.0, sides[1] * turn, 0.0, 0.0], EPISODE_STEPS - 10 - lift)


@dataclass
class CarryTarget(Script):
    """Two manipulators grip the last body, place it on the first and release it.

    Attributes:
        squeeze: Range of the depth to which each presses into the body before the lift [domain units].
        press: Range of the depth to which the body is pressed onto the other one [domain units].
    """

    squeeze: list[float]
    press: list[float]

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        base, cargo = scene.bodies[0], scene.bodies[-1]
        tools = [track.tool for track in tracks]
        squeeze, press = _draw(rng, "squeeze", self.squeeze), _draw(rng, "press", self.press)
        x, z = np.asarray(base.center)[[0, 2]] - np.asarray(cargo.center)[[0, 2]]
        rise = _top(base) - (cargo.center[1] - cargo.half_extent()[1]) + CLEARANCE
        # The leading sphere rises next to the base and passes its edge at the height of the top.
        lead = max(abs(tool.position[0] - cargo.center[0]) + _extent(tool, 1.0, 0.0, 0.0) for tool in tools)
        lowest = min(tool.position[1] - _extent(tool, 0.0, -1.0, 0.0) for tool in tools)
        edge = abs(x) - base.half_extent()[0] - lead
        beside = math.copysign(edge * rise / (_top(base) - lowest), x)
        for track in tracks:
            inwards = math.copysign(1.0, cargo.center[0] - track.tool.position[0])
            track.go([inwards * squeeze, 0.0, 0.0], 2)
            track.go([beside, rise, 0.0])
            track.go([x - beside, 0.0, z])
            track.go([0.0, -CLEARANCE - press, 0.0])
            track.go([-inwards * track.tool.scale[0] * 3, 0.0, 0.0])


@dataclass
class PushTarget(Script):
    """A manipulator between the legs of a table pushes one outwards at the end of the episode, while the
    rest of the table stays in place.

    Attributes:
        legs: Number of legs; these are the scene's first bodies.
        distance: Range of the distance travelled after contact with the leg [domain units].
        steps: Minimum number of environment steps; in a slower push the table follows.
    """

    legs: int
    distance: list[float]
    steps: int

    def plan(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> None:
        if not 0 < self.legs <= len(scene.bodies):
            raise TargetError(f"target.legs must be in 1 .. {len(scene.bodies)}, not {self.legs}")
        track, tool = tracks[0], tracks[0].tool
        leg = scene.bodies[rng.integers(self.legs)]
        way = (np.asarray(leg.center) - np.asarray(tool.position)) * [1.0, 0.0, 1.0]
        length = float(np.linalg.norm(way))
        direction = way / length
        edge = float(np.min(leg.half_extent() / np.maximum(np.abs(direction), 1e-9)))
        meet = length - edge - _extent(tool, *direction)
        track.go(meet * direction)
        track.go(_draw(rng, "distance", self.distance) * direction, self.steps)
        track.delay()


@dataclass
class Posture:
    """Joint positions at the end of one part of a gesture.

    Attributes:
        joints: Ranges of positions by patterns of joints. Joints that match one pattern move to the same
            sampled position; other joints do not move.
        steps: Minimum number of environment steps.
    """

    joints: dict[str, list[Any]]
    steps: int = 1


@dataclass
class GestureTarget(Script):
    """An articulated model moves through a sequence of postures and stays in the last one.

    Attributes:
        postures: The postures, in order.
    """

    postures: list[Posture]

    def sample(self, scene: Scene, tracks: list[ActionTrack], rng: np.random.Generator) -> np.ndarray:
        """Sample actions once; see :meth:`Script.sample`."""
        chain = scene.kinematics
        if chain is None:
            raise TargetError("target: the recipe needs a task with kinematics")
        joints = {joint.name: joint for joint in chain.joints}
        at = {name: joint.start for name, joint in joints.items()}
        rows = np.zeros((0, scene.action_dim))
        for number, posture in enumerate(self.postures):
            goal: dict[str, float] = {}
            for pattern, limits in posture.joints.items():
                value = _draw(rng, f"postures[{number}].joints.{pattern}", limits)
                with located("target", TargetError):
                    goal |= matched(f"postures[{number}]", {pattern: value}, list(joints))
            shares = {name: (to - at[name]) / joints[name].scale for name, to in goal.items()}
            steps = max(posture.steps, math.ceil(max(map(abs, shares.values()), default=0.0) - 1e-9))
            row = np.zeros(scene.action_dim)
            for name, share in shares.items():
                row[joints[name].component - len(chain.components)] = share / steps
            row = np.round(row, DECIMALS)
            rows = np.concatenate([rows, np.tile(row, (steps, 1))])
            for name, joint in joints.items():
                moved = at[name] + steps * joint.scale * row[joint.component - len(chain.components)]
                at[name] = min(max(moved, joint.low), joint.high)
        if len(rows) > EPISODE_STEPS:
            raise TargetError(
                f"the gesture takes {len(rows)} steps, more than {EPISODE_STEPS}: shorten its motions"
            )
        return np.pad(rows, ((0, EPISODE_STEPS - len(rows)), (0, 0)))


def _draw(rng: np.random.Generator, name: str, limits: Sequence[float]) -> float:
    """Sample uniformly from a range [low, high], after checking the range."""
    numbers = len(limits) == 2 and all(isinstance(limit, float | int) for limit in limits)
    if not numbers or not -math.inf < limits[0] <= limits[1] < math.inf:
        raise TargetError(f"target.{name} must be a range [low, high], not {list(limits)}")
    return rng.uniform(limits[0], limits[1])


def _count(rng: np.random.Generator, name: str, limits: Sequence[int]) -> int:
    """Sample an integer from a range, inclusive."""
    if len(limits) != 2 or not 1 <= limits[0] <= limits[1]:
        raise TargetError(f"target.{name} must be a range [low, high] with low >= 1, not {list(limits)}")
    return int(rng.integers(limits[0], limits[1] + 1))


def _top(body: Body) -> float:
    """Height of the top of a body [domain units]."""
    return body.center[1] + float(body.half_extent()[1])


def _extent(tool: Manipulator, *way: float) -> float:
    """Extent of a manipulator from its position along a unit vector [domain units]."""
    turn = scipy.spatial.transform.Rotation.from_quat(tool.rotation, scalar_first=True)
    return float(tool.kind.support(tool.size, turn.inv().apply(way)))  # type: ignore[misc]


def _touch(half: np.ndarray, direction: np.ndarray, radius: float) -> float:
    """Distance from the centre of a box, with half edges [3], at which a sphere approaching from a direction
    [3] makes contact [domain units]."""
    ways = np.linspace(0.0, np.linalg.norm(half) + radius, 1000)
    gaps = np.linalg.norm(np.maximum(ways[:, None] * np.abs(direction) - half, 0.0), axis=1)
    return float(np.interp(radius, gaps, ways))


def _arc(start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """Return points on an arc around the origin from one point to another, without the first; both [3]."""
    a, b = np.linalg.norm(start), np.linalg.norm(end)
    angle = math.acos(float(np.clip(start @ end / (a * b), -1.0, 1.0)))
    if angle < 1e-6:
        return [end]
    pieces = max(math.ceil(angle / 0.2), 1)
    points = []
    for t in np.arange(1, pieces + 1) / pieces:
        u = (math.sin((1 - t) * angle) * start / a + math.sin(t * angle) * end / b) / math.sin(angle)
        points.append(u * ((1 - t) * a + t * b))
    return points
