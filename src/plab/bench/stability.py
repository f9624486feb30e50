"""What the simulator survives: a matrix of cases that break simulators, and a count of those survived.

    python -m plab.bench.stability                      # everything, in both precisions
    python -m plab.bench.stability --quick              # a few minutes on two cores
    python -m plab.bench.stability --precision float32 --particles 1000 --csv cases.csv
    python -m plab.bench.stability --quick --family "1000 steps" --gradients norms.csv

Every case is simulated forwards and backwards. It has survived if state, loss terms and gradient are finite,
no particle ever moved by more than a cell in a substep, all particles are inside the domain, and the mass
tensor holds all mass. What cannot be simulated must be refused with the reason; those cases come last. The
exit code is 1 if any case failed. With ``--gradients`` the norm of the gradient is written for each step back
in time, and drawn into a PNG of the same name.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np

from plab.bench.stress_cases import StressCase, StressPlan, refusals
from plab.config.suite import suite_tasks
from plab.losses import make_terms
from plab.scenes import SceneError
from plab.sim import SimulationError, Simulator

__all__ = ["COLUMNS", "FULL", "QUICK", "REFUSAL", "run_cases", "run_refusals"]

BATCH = 12
"""Environments simulated together."""

MASS_TOLERANCE = {"float32": 1e-4, "float64": 1e-10}
"""Relative error allowed in the sum of a mass tensor: rounding of one addition per particle."""

REFUSAL = "refusal"
"""Family of the scenes that are to be refused."""

COLUMNS = ("precision", "family", "case", "outcome", "speed", "gradient", "where")

FULL = StressPlan(particles=300, long_tasks=tuple(suite_tasks()))
QUICK = StressPlan(particles=64, variants=("1",), long_tasks=("Move",))


def run_cases(cases: Sequence[StressCase], precision: str) -> Iterator[dict[str, object]]:
    """Run cases and judge them.

    Args:
        cases: The cases.
        precision: ``float32`` or ``float64``.

    Yields:
        A row of :data:`COLUMNS` per case: outcome (``survived`` or why not), fastest particle [cells per
        substep], largest gradient component, and the environment step of that component; beyond the columns
        ``norms``, those of the gradient with respect to each step's actions, shape [T].
    """
    for group in _groups(cases).values():
        scenes = [group[0].scene] * min(BATCH, len(group))
        terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": group[0].contact_weight})
        simulator = Simulator(scenes, terms=terms, precision=precision)
        simulator.set_target(*_target(simulator))
        for at in range(0, len(group), simulator.batch):
            part = group[at : at + simulator.batch]
            yield from ({"precision": precision, **row} for row in _run_together(simulator, part))
        # Taichi's memory goes with the simulator, before the next one is built.
        del simulator


def run_refusals() -> Iterator[dict[str, object]]:
    """Check that scenes that cannot be simulated are refused.

    Yields:
        A row of :data:`COLUMNS` per scene; ``where`` is the message.
    """
    for name, scene in refusals().items():
        outcome, why = "was not refused", ""
        try:
            scene.validate()
        except SceneError as error:
            outcome, why = "refused", str(error)
        values = ("any", REFUSAL, name, outcome, "", "", why)
        yield dict(zip(COLUMNS, values, strict=True))


def _groups(cases: Sequence[StressCase]) -> dict[tuple, list[StressCase]]:
    """Cases by what a compiled simulator is made for, and by what one rollout shares."""
    groups: dict[tuple, list[StressCase]] = {}
    for case in cases:
        scene = case.scene
        shapes = tuple(m.shape for m in scene.manipulators)
        kind = (shapes, scene.particle_count, scene.grid_size, scene.dt, scene.substeps)
        groups.setdefault((*kind, len(case.actions), case.contact_weight), []).append(case)
    return groups


def _target(simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Mass and distance of a ball in the middle, for all environments."""
    n = simulator.grid_size
    nodes = np.stack(np.meshgrid(*[np.arange(n) / n] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(nodes - (0.5, 0.3, 0.5), axis=-1) - 0.15
    mass = np.where(distance < 0.0, simulator.scenes[0].particle_mass, 0.0)
    shape = (simulator.batch, n, n, n)
    return np.broadcast_to(mass, shape), np.broadcast_to(np.maximum(distance, 0.0), shape)


def _run_together(simulator: Simulator, cases: Sequence[StressCase]) -> list[dict[str, object]]:
    """Run at most a batch of cases of one group."""
    full = [*cases, *([cases[-1]] * (simulator.batch - len(cases)))]
    _start(simulator, full)
    actions = np.stack([case.actions for case in full])
    rollout = simulator.rollout(actions, strict=False)
    state, mass = simulator.state(), simulator.mass_tensor()
    outcomes = [
        _outcome(simulator, case, rollout.failures.get(e), e, state, mass) for e, case in enumerate(cases)
    ]
    alive = [case for case, outcome in zip(cases, outcomes, strict=True) if outcome == "survived"]
    speeds = iter(_speeds(simulator, alive) if alive else [])
    rows = []
    for e, case in enumerate(cases):
        gradient = cast(np.ndarray, rollout.gradient)[e]
        sizes = np.abs(gradient).max(axis=1, initial=0.0)
        speed, outcome = math.nan, outcomes[e]
        if outcome == "survived":
            speed = next(speeds) * case.scene.dt / case.scene.dx
            # Written so that nan fails it, too.
            outcome = "survived" if speed <= 1.0 else "a particle crossed a cell in a substep"
        rows.append(
            {
                "family": case.family,
                "case": case.name,
                "outcome": outcome,
                "speed": f"{speed:.3f}",
                "gradient": f"{sizes.max():.3g}",
                "where": int(sizes.argmax()) + 1,
                "norms": np.linalg.norm(gradient, axis=1),
            }
        )
    return rows


def _start(simulator: Simulator, cases: Sequence[StressCase]) -> None:
    """Put a batch of cases into their initial states."""
    simulator.set_scenes([case.scene for case in cases])
    simulator.set_contact([case.contact for case in cases])
    state = simulator.state()
    for e, case in enumerate(cases):
        for name, value in case.state.items():
            getattr(state, name)[e] = value
    simulator.set_initial_state(state)


def _outcome(simulator, case: StressCase, failure: str | None, e: int, state, mass: np.ndarray) -> str:
    """Judge the end of a case."""
    if failure is not None:
        return failure
    if not all(np.isfinite(getattr(state, name)[e]).all() for name in ("x", "v", "C", "F", "poses")):
        return "the last state is not finite"
    if state.x[e].min() < 0.0 or state.x[e].max() > 1.0 - 2.999 * case.scene.dx:
        return "a particle left the domain"
    total = case.scene.particle_mass * case.scene.particle_count
    error = abs(mass[e].sum() / total - 1.0)
    if not error <= MASS_TOLERANCE[simulator.precision]:
        return f"mass changed by {error:.1e} of itself"
    return "survived"


def _speeds(simulator: Simulator, cases: Sequence[StressCase]) -> np.ndarray:
    """Largest speed of any particle after any environment step, shape [case]."""
    full = [*cases, *([cases[-1]] * (simulator.batch - len(cases)))]
    _start(simulator, full)
    fastest = np.zeros(simulator.batch)
    for t in range(len(cases[0].actions)):
        try:
            simulator.step(np.stack([case.actions[t] for case in full]))
        except SimulationError:
            # Stepping follows the rollout to rounding only, which decides in a chaotic case.
            fastest[:] = np.inf
            break
        fastest = np.maximum(fastest, np.linalg.norm(simulator.observe(1)[:, :, 3:], axis=2).max(axis=1))
    return fastest[: len(cases)]


if __name__ == "__main__":
    from plab.cli.bench import stability

    sys.exit(stability())
