"""Stability of the simulator under violent actions.

    plab bench stability                      # everything, in both precisions
    plab bench stability --quick              # a few minutes on two cores
    plab bench stability --precision float32 --particles 1000 --csv cases.csv
    plab bench stability --quick --family "1000 steps"

Cases are the suite's configurations under random and bang-bang actions, in both contact models, over 50
steps, and of first variants over 1000. Every case is simulated forwards and backwards. A case passes if
state, loss terms and gradient are finite, no particle moved by more than a cell in a substep, all particles
are inside the domain, and the mass tensor contains all mass. The exit code is 1 if any case failed.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from plab.bench.workload import with_particles
from plab.cli.command import Parser, command_line, positive, to_write
from plab.cli.tables import measure_table, print_table
from plab.config import ConfigError, build_scene
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.losses import make_terms
from plab.scenes import PRECISIONS, Scene
from plab.sim import Simulator, State

BATCH = 12
"""Environments simulated together."""

MASS_TOLERANCE = {"float32": 1e-4, "float64": 1e-10}
"""Relative error allowed in the sum of a mass tensor: rounding of one addition per particle."""

HOLD = 10
"""Longest duration of a bang-bang action [environment steps]."""

COLUMNS = ("precision", "family", "case", "outcome", "speed", "gradient", "where")


@dataclass(frozen=True)
class StressPlan:
    """Size of the matrix of cases.

    Attributes:
        particles: Particles per environment.
        variants: Variants of each task.
        long_tasks: Tasks simulated over the long horizon.
        long_horizon: Environment steps of the long horizon.
        horizon: Environment steps otherwise.
    """

    particles: int
    variants: tuple[str, ...] = SUITE_VARIANTS
    long_tasks: tuple[str, ...] = ()
    long_horizon: int = 1000
    horizon: int = 50


FULL = StressPlan(particles=300, long_tasks=tuple(suite_tasks()))
QUICK = StressPlan(particles=64, variants=("1",), long_tasks=("Move",))


@dataclass(frozen=True)
class StressCase:
    """A scene and actions of a stress test.

    Attributes:
        family: Group of cases.
        name: Name within the family.
        scene: The scene.
        actions: Actions, shape [T, A].
        contact: Contact model.
        state: Parts of the initial state that differ from rest: ``x``, ``v`` or ``F``, each [particle, ...].
        contact_weight: Weight of the loss's contact term.
    """

    family: str
    name: str
    scene: Scene
    actions: np.ndarray
    contact: str
    state: Mapping[str, np.ndarray] = field(default_factory=dict)
    contact_weight: float = 0.0


def random_actions(rng: np.random.Generator, steps: int, size: int) -> np.ndarray:
    """Uniform and independent, shape [steps, size]."""
    return rng.uniform(-1.0, 1.0, size=(steps, size))


def bang_bang_actions(rng: np.random.Generator, steps: int, size: int) -> np.ndarray:
    """Each component is at either end of its range, for up to :data:`HOLD` steps."""
    out = np.empty((steps, size))
    for column in out.T:
        lengths = rng.integers(1, HOLD + 1, size=steps)
        column[:] = np.repeat(rng.choice([-1.0, 1.0], size=steps), lengths)[:steps]
    return out


ACTIONS = {"random": random_actions, "bang-bang": bang_bang_actions}


def stress_cases(plan: StressPlan) -> Iterator[StressCase]:
    """Yield the configurations of a plan under random and bang-bang actions, in both contact models."""
    family = f"{plan.long_horizon} steps"
    short = itertools.product(["suite"], suite_tasks(), plan.variants)
    long = itertools.product([family], plan.long_tasks, ["1"])
    number = 0
    for family, task, variant in itertools.chain(short, long):
        scene = build_scene(with_particles([f"task={task}", f"variant={variant}"], plan.particles))
        steps = plan.horizon if family == "suite" else plan.long_horizon
        for kind, contact in itertools.product(ACTIONS, ("soft", "hard")):
            number += 1
            actions = ACTIONS[kind](np.random.default_rng(number), steps, scene.action_dim)
            name = f"{task}-v{variant} {kind} {contact}"
            yield StressCase(family, name, scene, actions, contact, contact_weight=1.0)


def run_cases(cases: Sequence[StressCase], precision: str) -> Iterator[dict[str, object]]:
    """Run and evaluate cases in a precision, ``float32`` or ``float64``.

    Yields:
        A row of :data:`COLUMNS` per case: outcome (``survived`` or the failure), fastest particle [cells per
        substep], largest gradient component, and the environment step of that component; beyond the columns
        ``norms``, those of the gradient with respect to each step's actions, shape [T].
    """
    for group in _groups(cases):
        terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": group[0].contact_weight})
        scenes = [group[0].scene] * min(BATCH, len(group))
        simulator = Simulator(scenes, terms=terms, precision=precision)
        simulator.set_target(*_target(simulator))
        for at in range(0, len(group), simulator.batch):
            yield from _run_together(simulator, group[at : at + simulator.batch])
        # Release the memory of the simulator before building the next one.
        del simulator


def _groups(cases: Sequence[StressCase]) -> list[list[StressCase]]:
    """Group the cases that can share a compiled simulator and a rollout."""
    groups: dict[tuple, list[StressCase]] = defaultdict(list)
    for case in cases:
        scene, shapes = case.scene, tuple(m.shape for m in case.scene.manipulators)
        kind = (shapes, scene.particle_count, scene.grid_size, scene.dt, scene.substeps)
        groups[(*kind, len(case.actions), case.contact_weight)].append(case)
    return list(groups.values())


def _target(simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Mass and distance of a ball in the middle, for all environments."""
    n = simulator.grid_size
    nodes = np.stack(np.meshgrid(*[np.arange(n) / n] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(nodes - (0.5, 0.3, 0.5), axis=-1) - 0.15
    mass = np.where(distance < 0.0, simulator.scenes[0].particle_mass, 0.0)
    shape = (simulator.batch, n, n, n)
    return np.broadcast_to(mass, shape), np.broadcast_to(np.maximum(distance, 0.0), shape)


def _run_together(simulator: Simulator, cases: Sequence[StressCase]) -> Iterator[dict[str, object]]:
    """Run up to a batch of cases of one group."""
    full = [*cases, *([cases[-1]] * (simulator.batch - len(cases)))]
    simulator.set_scenes([case.scene for case in full])
    simulator.set_contact([case.contact for case in full])
    start = simulator.state()
    for e, case in enumerate(full):
        for name, value in case.state.items():
            getattr(start, name)[e] = value
    simulator.set_initial_state(start)
    actions = np.stack([case.actions for case in full])
    rollout = simulator.rollout(actions, strict=False)
    state, mass = simulator.state(), simulator.mass_tensor()
    fastest = np.zeros(simulator.batch)
    simulator.reset()
    for t in range(actions.shape[1]):
        simulator.step(actions[:, t], check=False)
        fastest = np.maximum(fastest, np.linalg.norm(simulator.observe(1)[:, :, 3:], axis=2).max(axis=1))
    for e, case in enumerate(cases):
        gradient = cast(np.ndarray, rollout.gradient)[e]
        sizes = np.abs(gradient).max(axis=1, initial=0.0)
        speed = fastest[e] * case.scene.dt / case.scene.dx
        yield {
            "precision": simulator.precision,
            "family": case.family,
            "case": case.name,
            "outcome": rollout.failures.get(e) or _outcome(simulator.precision, case, e, state, mass, speed),
            "speed": f"{speed:.3f}",
            "gradient": f"{sizes.max():.3g}",
            "where": int(sizes.argmax()) + 1,
            "norms": np.linalg.norm(gradient, axis=1),
        }


def _outcome(precision: str, case: StressCase, e: int, state: State, mass: np.ndarray, speed: float) -> str:
    """Evaluate the last state of environment e, its mass tensor and its speed [cells per substep]."""
    if not all(np.isfinite(getattr(state, name)[e]).all() for name in ("x", "v", "C", "F", "poses")):
        return "the last state is not finite"
    if state.x[e].min() < 0.0 or state.x[e].max() > 1.0 - 2.999 * case.scene.dx:
        return "a particle left the domain"
    error = abs(mass[e].sum() / (case.scene.particle_mass * case.scene.particle_count) - 1.0)
    # NaN must fail these comparisons, too.
    if not error <= MASS_TOLERANCE[precision]:
        return f"mass changed by {error:.1e} of itself"
    return "survived" if speed <= 1.0 else "a particle crossed a cell in a substep"


def summarise(rows: Sequence[Mapping[str, object]]) -> int:
    """Print the number of passed cases per family; return the exit code."""
    survived: dict[tuple, list[bool]] = defaultdict(list)
    for row in rows:
        survived[row["precision"], row["family"]].append(row["outcome"] == "survived")
    every = [one for own in survived.values() for one in own]
    counts = [(*which, len(own), sum(own)) for which, own in survived.items()]
    print()
    columns = ("precision", "family", "cases", "survived")
    print_table(columns, [*counts, ("", "all", len(every), sum(every))])
    return 0 if all(every) else 1


@command_line
def main(argv: Sequence[str]) -> int:
    """Simulate the cases, print, write the requested file; return the exit code."""
    options = options_of(Parser("plab bench stability", __doc__), argv)
    return summarise(measure(options, stress_cases))


def options_of(parser: Parser, argv: Sequence[str]) -> argparse.Namespace:
    """Parse the options of a command that runs cases, in addition to those of the parser."""
    parser.add_argument("--quick", action="store_true", help="one variant of each task, fewer particles")
    parser.add_argument("--precision", choices=PRECISIONS, nargs="+", default=list(PRECISIONS))
    parser.add_argument("--particles", type=positive, help="particles per environment (300; 64 with --quick)")
    parser.add_argument("--horizon", type=positive, help="environment steps of the long horizon (1000)")
    parser.add_argument("--family", nargs="+", help="families of cases")
    parser.add_argument("--csv", type=to_write, help="file to write a row per case to")
    options = parser.parse_intermixed_args(argv)
    plan = QUICK if options.quick else FULL
    plan = replace(plan, particles=options.particles or plan.particles)
    options.plan = replace(plan, long_horizon=options.horizon or plan.long_horizon)
    return options


def measure(
    options: argparse.Namespace, cases_of: Callable[[StressPlan], Iterable[StressCase]]
) -> list[Mapping[str, object]]:
    """Run and print the cases selected by the options of :func:`options_of`; return the rows."""
    cases = list(cases_of(options.plan))
    families = list(dict.fromkeys(case.family for case in cases))
    if unknown := set(options.family or ()) - set(families):
        raise ConfigError(f"no cases of {', '.join(sorted(unknown))}; choose from: {', '.join(families)}")
    chosen = [case for case in cases if case.family in (options.family or families)]
    each = (run_cases(chosen, precision) for precision in options.precision)
    return measure_table(COLUMNS, itertools.chain.from_iterable(each), options.csv)


if __name__ == "__main__":
    sys.exit(main())
