"""Work-precision diagrams: cost of a simulation against its distance from a fine reference.

    plab bench accuracy --output accuracy           # a folder: CSV, and per task PNG, PDF, JSON
    plab bench accuracy --quick --output accuracy   # two tasks, coarser, fewer settings
    plab bench accuracy task=Move,Rope sim.device=cuda

Settings differ in the number of substeps (from below the stability limit upwards), precision, material
update (series or singular values), contact model, grid (with a constant number of particles per cell), and,
for the first task, law. The reference for each contact model and law uses float64 and many more substeps, or
the finest grid. Errors are the root mean square distance of the final positions [domain units], the L1
distance of the mass tensors relative to the mass, the score, and the relative norm and the angle of the
gradient. Run times are per environment step with gradient, for one environment.

The actions are 0.7 times those of a demonstration, and the target is the final state of the demonstration in
the hard contact model, so that scores correspond to partial success. The loss has the suite's terms of the
mass tensor.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from plab.bench.workload import with_particles
from plab.cli.command import Parser, command_line, folder, measure_table
from plab.config import build_scene
from plab.demonstrations import known_actions
from plab.losses import make_terms
from plab.objective import scores, spread_mass, target_sdf
from plab.plugins import pandas as pd
from plab.scenes import CONTACTS, LAWS, PRECISIONS, Body, Scene, sample_particles
from plab.sim import Simulator
from plab.sweep.execution import sweep_configs

TASKS = ("Move", "Rope", "RollingPin", "Chopsticks")
QUICK_TASKS = ("Move", "Rope")
STEP_TIME = 19e-4
"""Simulated time of an environment step of the suite [s]."""

ACTION_SCALE = 0.7
"""Factor on the demonstration's actions."""

ERRORS = ("positions", "mass", "score", "gradient", "angle_deg")

COLUMNS = (
    "axis", "task", "contact", "precision", "material", "law", "grid", "particles", "substeps", "ms_per_step",
    *ERRORS, "outcome",
)  # fmt: skip


class UncheckedScene(Scene):
    """A scene that may exceed the stability limit, for measuring the effect."""

    @property
    def stable_dt(self) -> float:
        """No limit on the time step."""
        return math.inf


class Setting(NamedTuple):
    """Discretisation and arithmetic of a simulation; ``axis`` is the varied quantity."""

    axis: str
    grid: int
    substeps: int
    precision: str = "float64"
    material: str = "series"
    law: str = "von_mises"


@dataclass(frozen=True)
class Plan:
    """Settings and references of a comparison.

    Attributes:
        grid: Grid of the settings that differ in substeps.
        substeps: Substeps of these settings.
        usual: Number of substeps for comparing materials and laws.
        reference: Substeps of the reference.
        grids: Grids; the last and finest is the reference.
        steps: Environment steps.
        particles: Particles at ``grid``.
        repeats: Number of timed rollouts after the first, which compiles; the fastest counts.
    """

    grid: int = 64
    substeps: tuple[int, ...] = (6, 8, 10, 14, 19, 38, 76)
    usual: int = 19
    reference: int = 304
    grids: tuple[int, ...] = (32, 48, 64, 96)
    steps: int = 50
    particles: int = 10000
    repeats: int = 2

    def settings(self) -> tuple[list[Setting], dict[tuple[str, str], Setting]]:
        """Return the settings to compare, and the references by axis and law."""
        # The suite's number of substeps per cell width.
        *coarse, finest = (Setting("grid", n, round(self.usual * n / self.grid)) for n in self.grids)
        out = [Setting("substeps", self.grid, s, p) for p in PRECISIONS for s in self.substeps]
        out += [Setting("substeps", self.grid, self.usual, p, "singular values") for p in PRECISIONS]
        exact = [Setting("substeps", self.grid, self.reference), finest]
        for law in sorted(set(LAWS) - {"von_mises"}):
            out += [Setting("law", self.grid, self.usual, precision, law=law) for precision in PRECISIONS]
            exact.append(Setting("law", self.grid, self.reference, law=law))
        return out + coarse, {(setting.axis, setting.law): setting for setting in exact}


QUICK = Plan(32, (3, 5, 10, 20), 10, reference=80, grids=(24, 32, 40), steps=20, particles=1000, repeats=1)


@dataclass(frozen=True)
class Result:
    """Outcome of one setting for a task in one contact model.

    Attributes:
        x: Initial, final and target positions, shape [particle, 3] each.
        gradient: Gradient of the loss per mass, shape [T, A].
        seconds: Run time of an environment step with gradient.
        outcome: ``stable``, or the failure.
    """

    x: tuple[np.ndarray, np.ndarray, np.ndarray]
    gradient: np.ndarray
    seconds: float
    outcome: str


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two arrays as vectors [degrees], accurate for small angles; NaN if one is 0."""
    a, b = a.ravel() / np.linalg.norm(a), b.ravel() / np.linalg.norm(b)
    return float(np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))))


def lattice(body: Body, spacing: float) -> np.ndarray:
    """Return particles on a lattice with ``spacing`` [domain units] in a body, shape [particle, 3]."""
    half = body.half_extent()
    counts = np.maximum(np.round(2.0 * half / spacing).astype(int), 1)
    axes = [(np.arange(n) + 0.5) / n * 2.0 * h - h for n, h in zip(counts, half, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if body.shape == "sphere":
        points = points[np.linalg.norm(points, axis=1) <= body.size[0]]
    return np.asarray(body.center) + points


class Attempt:
    """A task with test actions, and a target that they partially reach."""

    def __init__(self, task: str, plan: Plan, device: str) -> None:
        """Build the scene of the task's first variant."""
        cfg = with_particles([f"task={task}", "variant=1"], plan.particles)
        self._scene, self._plan, self._device = build_scene(cfg), plan, device
        self._demonstration = cast(np.ndarray, known_actions(cfg))[: plan.steps]
        self._ends: dict[tuple[str, str], np.ndarray] = {}

    def _start(self, setting: Setting) -> tuple[Scene, np.ndarray]:
        """Return the scene of a setting and its particles.

        For grids, particles are on a lattice with a fixed number per cell, because random particles would add
        larger differences than the grids.
        """
        plan, scene = self._plan, self._scene
        x = sample_particles(scene)
        if setting.axis == "grid":
            volume = sum(body.volume for body in scene.bodies)
            spacing = float(np.cbrt(volume / plan.particles)) * plan.grid / setting.grid
            parts = [lattice(body, spacing) for body in scene.bodies]
            counted = zip(scene.bodies, parts, strict=True)
            scene = replace(scene, bodies=tuple(replace(b, particles=len(own)) for b, own in counted))
            x = np.concatenate(parts)
        if setting.axis == "law":
            scene = replace(scene, bodies=tuple(replace(body, law=setting.law) for body in scene.bodies))
        dt = STEP_TIME / setting.substeps
        changes = {"grid_size": setting.grid, "substeps": setting.substeps, "dt": dt}
        return UncheckedScene(**vars(scene) | changes), x

    def run(self, setting: Setting, repeats: int) -> dict[str, Result]:
        """Simulate and time one setting; return one result per contact model. The first setting of an axis
        and law determines the target, the final state of the demonstration."""
        scene, x = self._start(setting)
        simulator = Simulator(
            [scene],
            # The suite's terms of the mass tensor.
            terms=make_terms({"density": 10.0, "sdf": 10.0}),
            precision=setting.precision,
            device=self._device,
            particles=[x],
            _singular_values=setting.material != "series",
        )
        key = setting.axis, setting.law
        if key not in self._ends:
            simulator.set_contact("hard")
            simulator.rollout(self._demonstration[None], gradient=False)
            self._ends[key] = simulator.state().x[0]
        end, mass = self._ends[key], scene.particle_mass * scene.particle_count
        target = spread_mass(end, scene.grid_size, mass / len(end))
        simulator.set_target(target[None], target_sdf(target, 0.1 * scene.particle_mass)[None])
        actions, found = ACTION_SCALE * self._demonstration[None], {}
        for contact in CONTACTS:
            simulator.set_contact(contact)
            seconds = []
            for _ in range(repeats + 1):
                begin = time.perf_counter()
                rollout = simulator.rollout(actions, strict=False)
                seconds.append((time.perf_counter() - begin) / actions.shape[1])
            gradient = cast(np.ndarray, rollout.gradient)[0] / mass
            outcome, ends = next(iter(rollout.failures.values()), "stable"), (x, simulator.state().x[0], end)
            found[contact] = Result(ends, gradient, min(seconds[1:] or seconds), outcome)
        return found


def errors_of(result: Result, exact: Result, grid: int, *, same_particles: bool) -> dict[str, float]:
    """Return the errors of a result by column, NaN if not applicable; mass tensors are compared on ``grid``
    nodes per axis."""
    errors = dict.fromkeys(ERRORS, math.nan)
    if result.outcome != "stable":
        return errors
    start, x, end = result.x
    initial, found, right, target = (spread_mass(p, grid, 1.0 / len(p)) for p in (start, x, exact.x[1], end))
    if same_particles:
        errors["positions"] = float(np.sqrt(((x - exact.x[1]) ** 2).sum(axis=1).mean()))
    errors["mass"] = float(np.abs(found - right).sum())
    judged = [scores(initial, tensor, target).score for tensor in (found, right)]
    errors["score"] = abs(judged[0] - judged[1])
    lengths = [np.linalg.norm(r.gradient) for r in (result, exact)]
    if all(lengths):
        # Without contact the gradient is zero and has no direction.
        errors["gradient"] = float(abs(lengths[0] / lengths[1] - 1.0))
        errors["angle_deg"] = angle(result.gradient, exact.gradient)
    return errors


def rows(tasks: Sequence[str], plan: Plan, device: str) -> Iterator[dict[str, Any]]:
    """Run a plan; yield a row of :data:`COLUMNS` per task, setting and contact model."""
    every, references = plan.settings()
    for task in tasks:
        attempt = Attempt(task, plan, device)
        # Each law is compiled anew.
        settings = [setting for setting in every if setting.axis != "law" or task == tasks[0]]
        axes = {(setting.axis, setting.law) for setting in settings}
        exact = {key: attempt.run(setting, 0) for key, setting in references.items() if key in axes}
        for setting in settings:
            same = setting.axis != "grid"
            for contact, result in attempt.run(setting, plan.repeats).items():
                nodes = plan.grid if same else plan.grids[0]
                errors = errors_of(
                    result, exact[setting.axis, setting.law][contact], nodes, same_particles=same
                )
                yield {
                    **setting._asdict(),
                    "task": task,
                    "contact": contact,
                    "particles": len(result.x[1]),
                    "ms_per_step": f"{1e3 * result.seconds:.3f}",
                    **{name: f"{value:.3g}" for name, value in errors.items()},
                    "outcome": result.outcome,
                }


@command_line
def main(argv: Sequence[str]) -> None:
    """Compare settings with references, print rows, and write table and diagrams."""
    from plab.report.figures import diagrams, save, style

    parser = Parser("plab bench accuracy", __doc__)
    add = parser.add_argument
    text = "coarser, fewer settings, 1000 particles instead of 10000, 20 steps"
    add("--quick", action="store_true", help=text)
    text = f"task (default: {','.join(TASKS)}; {','.join(QUICK_TASKS)} with --quick) and sim.device"
    add("overrides", nargs="*", help=text)
    add("--output", type=folder, default=Path("accuracy"), help="folder to write to")
    options = parser.parse_intermixed_args(argv)
    default, output = QUICK_TASKS if options.quick else TASKS, options.output
    cfgs = sweep_configs(options.overrides, {"task": default}, ("task", "sim.device"))
    tasks = [cfg.task.name for cfg in cfgs]
    if unknown := set(tasks) - set(TASKS):
        parser.error(f"no diagrams for {', '.join(sorted(unknown))}; choose from: {', '.join(TASKS)}")
    found = rows(tasks, QUICK if options.quick else Plan(), cfgs[0].sim.device)
    table = measure_table(COLUMNS, found, output / "accuracy.csv")
    with style():
        drawings = diagrams(pd.DataFrame(table))
        save(drawings, output, "plab bench accuracy")
    for drawing in drawings:
        print(output / f"{drawing.name}.png")
