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

import argparse
import itertools
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd

from plab.bench.stress_cases import Case, Plan, refusals, stress_cases
from plab.cli.arguments import Parser, positive, to_write
from plab.cli.command import command_line
from plab.cli.tables import measure_table, print_table, write_csv
from plab.config import ConfigError
from plab.config.suite import suite_tasks
from plab.errors import tell
from plab.losses import make_terms
from plab.report.figures import legend, log_axis, single, style
from plab.scene import SceneError
from plab.sim import PRECISIONS, SimulationError, Simulator

__all__ = ["main", "run_cases", "run_refusals", "write_norms"]

BATCH = 12
"""Environments simulated together."""

MASS_TOLERANCE = {"float32": 1e-4, "float64": 1e-10}
"""Relative error allowed in the sum of a mass tensor: rounding of one addition per particle."""

LABELLED = 12
"""With more cases than this a figure of norms has no legend: colours repeat."""

REFUSAL = "refusal"
"""Family of the scenes that are to be refused."""

COLUMNS = ("precision", "family", "case", "outcome", "speed", "gradient", "where")

FULL = Plan(particles=300, long_tasks=tuple(suite_tasks()))
QUICK = Plan(particles=64, variants=("1",), long_tasks=("Move",))


def run_cases(cases: Sequence[Case], precision: str) -> Iterator[dict[str, object]]:
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


def _groups(cases: Sequence[Case]) -> dict[tuple, list[Case]]:
    """Cases by what a compiled simulator is made for, and by what one rollout shares."""
    groups: dict[tuple, list[Case]] = {}
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


def _run_together(simulator: Simulator, cases: Sequence[Case]) -> list[dict[str, object]]:
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


def _start(simulator: Simulator, cases: Sequence[Case]) -> None:
    """Put a batch of cases into their initial states."""
    simulator.set_scenes([case.scene for case in cases])
    simulator.set_contact([case.contact for case in cases])
    state = simulator.state()
    for e, case in enumerate(cases):
        for name, value in case.state.items():
            getattr(state, name)[e] = value
    simulator.set_initial_state(state)


def _outcome(simulator, case: Case, failure: str | None, e: int, state, mass: np.ndarray) -> str:
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


def _speeds(simulator: Simulator, cases: Sequence[Case]) -> np.ndarray:
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


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run, print, write a CSV file if asked to; return the exit code."""
    parser = Parser("plab.bench.stability", __doc__)
    parser.add_argument("--quick", action="store_true", help="one variant of each task, fewer particles")
    parser.add_argument("--precision", choices=PRECISIONS, nargs="+", default=list(PRECISIONS))
    parser.add_argument("--particles", type=positive, help="particles per environment (300; 64 with --quick)")
    parser.add_argument("--horizon", type=positive, help="environment steps of the long horizon (1000)")
    parser.add_argument("--family", nargs="+", help="only these families of cases")
    parser.add_argument("--csv", type=to_write, help="file to write a row per case to")
    what = "file for the gradient's norm per step back in time"
    parser.add_argument("--gradients", type=to_write, help=what)
    options = parser.parse_args(argv)
    cases = _cases(options)
    rows = itertools.chain.from_iterable(run_cases(cases, precision) for precision in options.precision)
    refused = run_refusals() if not options.family or REFUSAL in options.family else ()
    table = measure_table(COLUMNS, itertools.chain(rows, refused), options.csv)
    if options.gradients is not None:
        write_norms(table, options.gradients)
    return _summarise(pd.DataFrame(table))


def _cases(options: argparse.Namespace) -> list[Case]:
    """Return the cases that are asked for."""
    plan = QUICK if options.quick else FULL
    plan = replace(plan, particles=options.particles or plan.particles)
    plan = replace(plan, long_horizon=options.horizon or plan.long_horizon)
    cases = stress_cases(plan)
    families = list(dict.fromkeys([case.family for case in cases] + [REFUSAL]))
    if unknown := set(options.family or ()) - set(families):
        raise ConfigError(f"no cases of {', '.join(sorted(unknown))}; choose from: {', '.join(families)}")
    return [case for case in cases if not options.family or case.family in options.family]


def write_norms(rows: Sequence[Mapping[str, object]], path: Path) -> None:
    """Write, and draw, the norm of the gradient for each step back in time.

    Args:
        rows: What :func:`run_cases` yields; others are left out.
        path: CSV file; the drawing is a PNG of the same name.
    """
    parts = [
        (row["precision"], row["family"], row["case"], norms[::-1])
        for row in rows
        if (norms := cast("np.ndarray | None", row.get("norms"))) is not None
    ]
    if not parts:
        tell("no case has a gradient")
        return
    table = [(*which, back, norm) for *which, norms in parts for back, norm in enumerate(norms)]
    write_csv(path, [("precision", "family", "case", "back", "norm"), *table], digits=6)
    with style():
        figure, panel = single(7.0, 4.0)
        colours: dict[str, str] = {}
        for precision, _family, case, norms in parts:
            label = None if case in colours else str(case)
            colour = colours.setdefault(str(case), f"C{len(colours) % 10}")
            # Steps that nothing depends on have no place on a log scale.
            norms = np.where(norms > 0, norms, np.nan)
            panel.plot(norms, "-" if precision == "float32" else ":", color=colour, label=label)
        panel.set_xlabel("environment steps back from the end")
        panel.set_title("solid: float32, dotted: float64", loc="right")
        log_axis(panel, "norm of a step's gradient", vertical=True)
        if len(colours) <= LABELLED:
            legend(figure, columns=3)
        figure.savefig(path.with_suffix(".png"))
    print(path.with_suffix(".png"))


def _summarise(table: pd.DataFrame) -> int:
    """Print how many cases of each family survived; return the exit code."""
    table["survived"] = table["outcome"].isin(["survived", "refused"])
    groups = table.groupby(["precision", "family"], sort=False, as_index=False)["survived"]
    rows = groups.agg(["size", "sum"]).itertuples(index=False, name=None)
    total = ("", "all", len(table), table["survived"].sum())
    print()
    print_table(("precision", "family", "cases", "survived"), [*rows, total])
    return 0 if table["survived"].all() else 1


if __name__ == "__main__":
    sys.exit(main())
