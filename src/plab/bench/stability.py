"""Stability of the simulator under extreme actions.

    plab bench stability                      # everything, in both precisions
    plab bench stability --quick              # a few minutes on two cores
    plab bench stability sim.precision=float32 --csv cases.csv
    plab bench stability sim.device=cuda

Cases are the suite's configurations under random and bang-bang actions, in both contact models, over 50
steps, and first variants over 1000 steps. Every case is simulated forwards and backwards. A case passes if
state, loss terms and gradient are finite, no particle moved by more than a cell in a substep, all particles
are inside the domain, and the mass tensor contains all mass. The exit code is 1 if any case failed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from plab.bench.workload import with_particles
from plab.cli.command import Parser, command_line, measure_table, print_table, to_write
from plab.config import build_scene
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.losses import make_terms
from plab.scenes import CONTACTS, PRECISIONS
from plab.sim import Simulator, State
from plab.sweep.execution import sweep_configs

MASS_TOLERANCE = {"float32": 1e-4, "float64": 1e-10}
"""Relative error allowed in the sum of a mass tensor: rounding of one addition per particle."""

HOLD = 10
"""Longest duration of a bang-bang action [environment steps]."""

COLUMNS = ("precision", "family", "case", "outcome", "speed", "gradient", "where")


def bang_bang_actions(rng: np.random.Generator, steps: int, size: int) -> np.ndarray:
    """Actions whose components are at either end of their range for up to :data:`HOLD` steps each."""
    out = np.empty((steps, size))
    for column in out.T:
        lengths = rng.integers(1, HOLD + 1, size=steps)
        column[:] = np.repeat(rng.choice([-1.0, 1.0], size=steps), lengths)[:steps]
    return out


ACTIONS = {
    "random": lambda rng, steps, size: rng.uniform(-1.0, 1.0, size=(steps, size)),
    "bang-bang": bang_bang_actions,
}


def rows(precision: str, quick: bool, device: str) -> Iterator[dict[str, object]]:
    """Run all cases, one task at a time; yield a row of :data:`COLUMNS` per case."""
    tasks, number = suite_tasks(), itertools.count(1)
    short = [("suite", task, SUITE_VARIANTS[:1] if quick else SUITE_VARIANTS, 50) for task in tasks]
    long = [("1000 steps", task, ("1",), 1000) for task in (["Move"] if quick else tasks)]
    for family, task, variants, steps in short + long:
        cases = list(itertools.product(variants, ACTIONS, CONTACTS))
        words = {variant: [f"task={task}", f"variant={variant}"] for variant in variants}
        built = {name: build_scene(with_particles(own, 64 if quick else 300)) for name, own in words.items()}
        scenes = [built[variant] for variant, *_ in cases]
        size = scenes[0].action_dim
        actions = [ACTIONS[kind](np.random.default_rng(next(number)), steps, size) for _, kind, _ in cases]
        simulator = stress_simulator(scenes, precision, contact_weight=1.0, device=device)
        simulator.set_contact([contact for *_, contact in cases])
        for (variant, kind, contact), found in zip(cases, stress(simulator, np.stack(actions)), strict=True):
            name = f"{task}-v{variant} {kind} {contact}"
            yield {"precision": precision, "family": family, "case": name, **found}


def stress_simulator(
    scenes: Sequence[Any], precision: str, contact_weight: float, device: str = "cpu"
) -> Simulator:
    """Return a simulator of some scenes whose target is a ball in the centre."""
    terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": contact_weight})
    simulator = Simulator(scenes, terms=terms, precision=precision, device=device)
    n = simulator.grid_size
    nodes = np.stack(np.meshgrid(*[np.arange(n) / n] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(nodes - (0.5, 0.3, 0.5), axis=-1) - 0.15
    mass = np.where(distance < 0.0, scenes[0].particle_mass, 0.0)
    shape = (simulator.batch, n, n, n)
    simulator.set_target(np.broadcast_to(mass, shape), np.broadcast_to(np.maximum(distance, 0.0), shape))
    return simulator


def stress(simulator: Simulator, actions: np.ndarray) -> Iterator[dict[str, Any]]:
    """Simulate actions, shape [batch, T, A], forwards and backwards.

    Yields:
        For each environment: outcome (``survived`` or the failure), speed of the fastest particle [cells per
        substep], largest gradient component, the environment step of that component, and ``norms`` of the
        gradient with respect to each step's actions, shape [T].
    """
    rollout: Any = simulator.rollout(actions, strict=False)
    state, mass = simulator.state(), simulator.mass_tensor()
    fastest = np.zeros(simulator.batch)
    simulator.reset()
    for t in range(actions.shape[1]):
        simulator.step(actions[:, t], check=False)
        fastest = np.maximum(fastest, np.linalg.norm(simulator.observe(1)[:, :, 3:], axis=2).max(axis=1))
    for e, scene in enumerate(simulator.scenes):
        sizes = np.abs(rollout.gradient[e]).max(axis=1, initial=0.0)
        speed = fastest[e] * scene.dt / scene.dx
        yield {
            "outcome": rollout.failures.get(e) or _outcome(simulator, e, state, mass, speed),
            "speed": f"{speed:.3f}",
            "gradient": f"{sizes.max():.3g}",
            "where": int(sizes.argmax()) + 1,
            "norms": np.linalg.norm(rollout.gradient[e], axis=1),
        }


def _outcome(simulator: Simulator, e: int, state: State, mass: np.ndarray, speed: float) -> str:
    """Evaluate the last state of environment e, its mass tensor and its speed [cells per substep]."""
    scene = simulator.scenes[e]
    if not all(np.isfinite(getattr(state, name)[e]).all() for name in ("x", "v", "C", "F", "poses")):
        return "the last state is not finite"
    if state.x[e].min() < 0.0 or state.x[e].max() > 1.0 - 2.999 * scene.dx:
        return "a particle left the domain"
    error = abs(mass[e].sum() / (scene.particle_mass * scene.particle_count) - 1.0)
    # NaN must fail these comparisons, too.
    if not error <= MASS_TOLERANCE[simulator.precision]:
        return f"mass changed by a fraction of {error:.1e}"
    return "survived" if speed <= 1.0 else "a particle crossed a cell in a substep"


def summarise(rows: Iterable[Mapping[str, object]]) -> int:
    """Print the number of passed cases per family; return the exit code."""
    table = pd.DataFrame(rows)
    passed = table["outcome"] == "survived"
    counts = passed.groupby([table["precision"], table["family"]], sort=False).agg(["size", "sum"])
    print()
    print_table(("precision", "family", "cases", "survived"), counts.reset_index().itertuples(index=False))
    return 0 if passed.all() else 1


@command_line
def main(argv: Sequence[str]) -> int:
    """Simulate the cases, print rows, and write the requested file; return the exit code."""
    parser = Parser("plab bench stability", __doc__)
    what = "one variant of each task, 64 particles instead of 300"
    parser.add_argument("--quick", action="store_true", help=what)
    parser.add_argument("overrides", nargs="*", help="sim.device and sim.precision (default: both)")
    parser.add_argument("--csv", type=to_write, help="file to write a row per case to")
    options = parser.parse_intermixed_args(argv)
    cfgs = sweep_configs(options.overrides, {"sim.precision": PRECISIONS}, ("sim.device", "sim.precision"))
    each = (rows(cfg.sim.precision, options.quick, cfg.sim.device) for cfg in cfgs)
    return summarise(measure_table(COLUMNS, itertools.chain.from_iterable(each), options.csv))
