"""Work-precision diagrams: what a run costs against how far it is from a fine reference.

    python -m plab.bench.accuracy --output accuracy           # a folder: CSV, and per task PNG, PDF, JSON
    python -m plab.bench.accuracy --quick --output accuracy   # two tasks, coarser, fewer settings
    python -m plab.bench.accuracy --task Move,Rope --particles 3000
    python -m plab.bench.accuracy --device cuda --output accuracy_cuda

Settings differ in the number of substeps, from below the stability limit upwards, in precision, in how the
material is computed (series or singular values), in contact model, and in the grid, with as many particles
per cell. Each is compared with a reference of its contact model in float64 with many more substeps (for the
grids: on the finest of them): root mean square of the final positions' distances [domain units], L1 distance
of the mass tensors relative to the mass, score, and the gradient's relative norm and angle. Run times are
those of an environment step with gradient, of one environment.

The actions are 0.7 times a demonstration's, and the target is what the demonstration itself ends with in the
hard contact model, so that scores are those of an attempt that half succeeds. The loss has no contact term,
see :mod:`plab.bench.common_scene`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import cast

import numpy as np

from plab.bench.common_scene import (
    common_actions,
    common_places,
    common_scene,
    grid_terms,
    own_components,
)
from plab.bench.precision import angle
from plab.config import Config, build_scene, load_config
from plab.demonstrations import known_actions
from plab.objective import scores, spread_mass, target_sdf
from plab.scenes import CONTACTS, PRECISIONS, Body, Scene, sample_particles
from plab.sim import Simulator

__all__ = ["COLUMNS", "QUICK", "QUICK_TASKS", "TASKS", "Plan", "Resolution", "attempts_at", "lattice", "rows"]

TASKS = ("Move", "Rope", "RollingPin", "Chopsticks")
QUICK_TASKS = ("Move", "Rope")
STEP_TIME = 19e-4
"""Simulated time of an environment step of the suite [s]."""

EFFORT = 0.7
"""Factor on the demonstration's actions."""

COLUMNS = (
    "axis", "task", "contact", "precision", "material", "grid", "particles", "substeps", "ms_per_step",
    "positions", "mass", "score", "gradient", "angle_deg", "outcome",
)  # fmt: skip


class UncheckedScene(Scene):
    """A scene that may be above the stability limit, to show what happens there."""

    @property
    def stable_dt(self) -> float:
        """No limit."""
        return float("inf")


@dataclass(frozen=True)
class Resolution:
    """How something is simulated.

    Attributes:
        axis: What is varied: ``substeps`` or ``grid``.
        grid: Grid nodes per axis.
        substeps: Substeps per environment step.
        precision: ``float32`` or ``float64``.
        material: ``series`` or ``singular values``.
    """

    axis: str
    grid: int
    substeps: int
    precision: str = "float64"
    material: str = "series"


@dataclass(frozen=True)
class Plan:
    """What is run.

    Attributes:
        grid: Grid of the settings that differ in substeps.
        substeps: Their substeps.
        usual: Number of substeps for which the materials are compared.
        reference: Substeps of the reference.
        grids: Grids, the finest last; it is the reference.
        steps: Environment steps.
        particles: Particles at ``grid``.
        repeats: Timed rollouts.
    """

    grid: int = 64
    substeps: tuple[int, ...] = (6, 8, 10, 14, 19, 38, 76)
    usual: int = 19
    reference: int = 304
    grids: tuple[int, ...] = (32, 48, 64, 96)
    steps: int = 50
    particles: int = 10000
    repeats: int = 2
    device: str = "cpu"

    def settings(self) -> list[Resolution]:
        """All settings but the references."""
        out = [Resolution("substeps", self.grid, s, p) for p in PRECISIONS for s in self.substeps]
        out += [Resolution("substeps", self.grid, self.usual, p, "singular values") for p in PRECISIONS]
        return out + [Resolution("grid", n, self._substeps_of(n)) for n in self.grids[:-1]]

    def references(self) -> dict[str, Resolution]:
        """Reference by axis."""
        finest = self.grids[-1]
        return {
            "substeps": Resolution("substeps", self.grid, self.reference),
            "grid": Resolution("grid", finest, self._substeps_of(finest)),
        }

    def _substeps_of(self, grid: int) -> int:
        """As many substeps per cell width as the suite has."""
        return round(self.usual * grid / self.grid)


QUICK = Plan(32, (3, 5, 10, 20), 10, reference=80, grids=(24, 32, 40), steps=20, particles=1000, repeats=1)


@dataclass(frozen=True)
class Result:
    """What a setting made of a task.

    Attributes:
        x: Final positions, shape [particle, 3].
        gradient: Gradient of the loss per mass, shape [T, A].
        seconds: Run time of an environment step with gradient.
        outcome: ``stable``, or what went wrong.
    """

    x: np.ndarray
    gradient: np.ndarray
    seconds: float
    outcome: str


def lattice(bodies: Sequence[Body], spacing: float) -> list[np.ndarray]:
    """Particles on a regular lattice inside each body.

    Args:
        bodies: The bodies.
        spacing: Distance of neighbours [domain units].

    Returns:
        Positions for each body, each [particle, 3].
    """
    out = []
    for body in bodies:
        half = body.half_extent()
        counts = np.maximum(np.round(2.0 * half / spacing).astype(int), 1)
        axes = [(np.arange(n) + 0.5) / n * 2.0 * h - h for n, h in zip(counts, half, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        if body.shape == "sphere":
            points = points[np.linalg.norm(points, axis=1) <= body.size[0]]
        out.append(np.asarray(body.center) + points)
    return out


def attempts_at(tasks: Sequence[str], plan: Plan) -> list[Attempt]:
    """Return the first variants of tasks, in a common kind of scene."""
    cfgs = [load_config([f"task={task}", "variant=1"]) for task in tasks]
    places = common_places([build_scene(cfg) for cfg in cfgs])
    return [Attempt(cfg, plan, places) for cfg in cfgs]


class Attempt:
    """A task with the actions that are tried and the targets that they half reach."""

    def __init__(self, cfg: Config, plan: Plan, places: Sequence[str]) -> None:
        """Build the task's scene.

        Args:
            cfg: Configuration of the task.
            plan: Numbers of environment steps and particles.
            places: Shapes of the manipulators of the common scene.
        """
        self.task = cfg.task.name
        self.scene = build_scene(cfg)
        self.components = own_components(self.scene, places)
        self.demonstration = common_actions(
            self.scene, cast(np.ndarray, known_actions(cfg))[: plan.steps], places
        )
        self.targets: dict[str, np.ndarray] = {}
        self._plan = plan
        self._places = places

    def start(self, setting: Resolution) -> tuple[Scene, np.ndarray]:
        """Return the common scene of a setting and its particles.

        Grids have particles on a lattice, as many per cell: random ones would differ between grids by more
        than what is to be seen.
        """
        plan, scene = self._plan, self.scene
        if setting.axis == "grid":
            volume = sum(_volume(body) for body in scene.bodies)
            parts = lattice(scene.bodies, np.cbrt(volume / plan.particles) * plan.grid / setting.grid)
            counted = zip(scene.bodies, parts, strict=True)
            scene = replace(scene, bodies=tuple(replace(b, particles=len(x)) for b, x in counted))
            scene = common_scene(scene, scene.particle_count, self._places)
            x = np.concatenate(parts)
        else:
            scene = common_scene(scene, plan.particles, self._places)
            x = sample_particles(scene)
        values = {field.name: getattr(scene, field.name) for field in fields(Scene)}
        values |= {"grid_size": setting.grid, "substeps": setting.substeps}
        return UncheckedScene(**values | {"dt": STEP_TIME / setting.substeps}), x


def _volume(body: Body) -> float:
    return float(np.prod(body.size)) if body.shape == "box" else 4.0 / 3.0 * np.pi * body.size[0] ** 3


def simulate(setting: Resolution, attempts: Sequence[Attempt], repeats: int, device: str) -> Iterator[tuple]:
    """Run all tasks and contact models in one setting.

    Args:
        setting: The setting.
        attempts: The tasks. Where one has no target for the setting's axis yet, its demonstration is run
            first, and what that ends with becomes the target.
        repeats: Rollouts after the first, which compiles; the fastest of them is timed.
        device: ``cpu`` or ``cuda``.

    Yields:
        Task, contact model and :class:`Result`.
    """
    simulator = None
    for attempt in attempts:
        scene, x = attempt.start(setting)
        if simulator is None or simulator.particle_count != scene.particle_count:
            # Taichi's memory goes with the old simulator, before there is a new one.
            simulator = None
            simulator = Simulator(
                [scene],
                terms=grid_terms(),
                precision=setting.precision,
                device=device,
                particles=[x],
                _singular_values=setting.material != "series",
            )
        simulator.set_scenes([scene], particles=[x])
        if setting.axis not in attempt.targets:
            simulator.set_contact("hard")
            simulator.rollout(attempt.demonstration[None], gradient=False)
            attempt.targets[setting.axis] = simulator.state().x[0]
        end = attempt.targets[setting.axis]
        mass = scene.particle_mass * scene.particle_count
        target = spread_mass(end, scene.grid_size, mass / len(end))
        simulator.set_target(target[None], target_sdf(target, 0.1 * scene.particle_mass)[None])
        for contact in CONTACTS:
            simulator.set_contact(contact)
            yield attempt, contact, _roll(simulator, attempt, repeats, mass)


def _roll(simulator: Simulator, attempt: Attempt, repeats: int, mass: float) -> Result:
    """Run and time one task in one contact model."""
    actions = EFFORT * attempt.demonstration[None]
    seconds = []
    # The first rollout compiles.
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        rollout = simulator.rollout(actions, strict=False)
        seconds.append((time.perf_counter() - begin) / actions.shape[1])
    gradient = cast(np.ndarray, rollout.gradient)[0][:, attempt.components] / mass
    outcome = next(iter(rollout.failures.values()), "stable")
    return Result(simulator.state().x[0], gradient, min(seconds[1:] or seconds), outcome)


def judge(
    setting: Resolution, attempt: Attempt, result: Result, exact: Result, grid: int
) -> dict[str, float]:
    """Return the errors of a result by column, NaN where there is nothing to compare; mass tensors are
    compared on so many grid nodes per axis."""
    start = attempt.start(setting)[1]
    target = spread_mass(attempt.targets[setting.axis], grid, 1.0 / len(attempt.targets[setting.axis]))
    errors = dict.fromkeys(("positions", "mass", "score", "gradient", "angle_deg"), float("nan"))
    if result.outcome != "stable":
        return errors
    tensors = [spread_mass(x, grid, 1.0 / len(x)) for x in (start, result.x, exact.x)]
    judged = [scores(tensors[0], tensor, target).score for tensor in tensors[1:]]
    if setting.axis == "substeps":
        errors["positions"] = float(np.sqrt(((result.x - exact.x) ** 2).sum(axis=1).mean()))
    errors["mass"] = float(np.abs(tensors[1] - tensors[2]).sum())
    errors["score"] = abs(judged[0] - judged[1])
    lengths = [np.linalg.norm(r.gradient) for r in (result, exact)]
    if all(lengths):
        # Without contact there is no gradient, hence no direction.
        errors["gradient"] = float(abs(lengths[0] / lengths[1] - 1.0))
        errors["angle_deg"] = angle(result.gradient, exact.gradient)
    return errors


def rows(tasks: Sequence[str], plan: Plan) -> Iterator[dict[str, object]]:
    """Run a plan; yields a row of :data:`COLUMNS` per setting, task and contact model."""
    attempts = attempts_at(tasks, plan)
    exact: dict[tuple[str, str, str], Result] = {}
    for axis, setting in plan.references().items():
        for attempt, contact, result in simulate(setting, attempts, 0, plan.device):
            exact[axis, attempt.task, contact] = result
    grids = {"substeps": plan.grid, "grid": plan.grids[0]}
    for setting in plan.settings():
        for attempt, contact, result in simulate(setting, attempts, plan.repeats, plan.device):
            errors = judge(
                setting, attempt, result, exact[setting.axis, attempt.task, contact], grids[setting.axis]
            )
            yield vars(setting) | {
                "task": attempt.task,
                "contact": contact,
                "particles": len(result.x),
                "ms_per_step": f"{1e3 * result.seconds:.3f}",
                **{name: f"{value:.3g}" for name, value in errors.items()},
                "outcome": result.outcome,
            }


if __name__ == "__main__":
    from plab.cli.bench import accuracy

    sys.exit(accuracy())
