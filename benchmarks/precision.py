"""Comparison of float32 with float64 on the fifty configurations: demonstrations and random actions.

    python benchmarks/precision.py --csv precision.csv --markdown precision.md
    python benchmarks/precision.py --particles 10000                     # as in the tasks
    python benchmarks/precision.py --device cuda --deterministic         # float32 with integer sums

prints a row per configuration and kind of actions: the scores in both precisions in the hard contact model,
and the difference between the gradients of the trajectory loss in the soft one, over 50 steps. All
configurations share one compiled simulator per precision, see ``common_scene.py``; the loss has no contact
term.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pandas as pd

from common_scene import common_actions, common_scene, grid_terms, own_components
from plab.bench.accuracy import angle
from plab.cli.command import Parser, command_line, measure_table, positive, to_write
from plab.config import build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.demonstrations import known_actions
from plab.objective import TARGET_MASS, scores, spread_mass, target_sdf
from plab.scenes import DEVICES, Scene, sample_particles
from plab.sim import Simulator
from plab.targets import EPISODE_STEPS

COLUMNS = (
    "task", "variant", "actions", "score_float32", "score_float64", "difference", "positions_rms", "mass_l1",
    "gradient_norm", "norm_ratio", "angle_deg", "failures",
)  # fmt: skip


@dataclass(frozen=True)
class Start:
    """A configuration in the common kind of scene.

    Attributes:
        task: Task.
        variant: Variant.
        scene: The common scene.
        particles: Number of particles in the task.
        components: Indices of the task's action components.
        actions: Demonstration and random actions, each [T, A'].
    """

    task: str
    variant: str
    scene: Scene
    particles: int
    components: list[int]
    actions: dict[str, np.ndarray]


@dataclass(frozen=True)
class Simulated:
    """Scores, states and gradients of some actions in one precision.

    Attributes:
        x: Final positions in the hard contact model, shape [particle, 3].
        gradient: Gradient in the soft contact model, shape [T, A].
        failures: Failures by environment.
    """

    x: np.ndarray
    gradient: np.ndarray
    failures: str


def starts(tasks: Sequence[str], variants: Sequence[str], particles: int) -> list[Start]:
    """Return all configurations of some tasks."""
    out: list[Start] = []
    for task in tasks:
        for variant in variants:
            cfg = load_config([f"task={task}", f"variant={variant}"])
            scene, known = build_scene(cfg), known_actions(cfg)
            rng = np.random.default_rng(len(out))
            shown = np.zeros((EPISODE_STEPS, scene.action_dim)) if known is None else known[:EPISODE_STEPS]
            drawn = rng.uniform(-1.0, 1.0, size=(EPISODE_STEPS, scene.action_dim))
            actions = {"demonstration": common_actions(scene, shown), "random": common_actions(scene, drawn)}
            common = common_scene(scene, particles)
            out.append(Start(task, variant, common, scene.particle_count, own_components(scene), actions))
    return out


def run(configurations: Sequence[Start], targets: list[np.ndarray] | None, **sim: Any) -> Iterator:
    """Run all configurations in one precision.

    Args:
        configurations: The configurations.
        targets: A mass tensor for each; default: the final state of the demonstration.
        sim: Precision, device and determinism, as arguments of :class:`plab.sim.Simulator`.

    Yields:
        For each configuration, its target and a :class:`Simulated` per kind of actions.
    """
    simulator = Simulator([configurations[0].scene], terms=grid_terms(), **sim)
    for number, start in enumerate(configurations):
        simulator.set_scenes([start.scene])
        final = {}
        for kind, actions in start.actions.items():
            simulator.set_contact("hard")
            hard = simulator.rollout(actions[None], gradient=False, strict=False)
            final[kind] = simulator.state().x[0], list(hard.failures.values())
        target = targets[number] if targets else mass_of(start.scene, final["demonstration"][0])
        # As much less as there are fewer particles than the task has.
        threshold = TARGET_MASS * start.scene.particle_count / start.particles
        simulator.set_target(target[None], target_sdf(target, threshold)[None])
        outcomes = {}
        for kind, actions in start.actions.items():
            simulator.set_contact("soft")
            soft = simulator.rollout(actions[None], strict=False)
            x, failures = final[kind]
            text = "; ".join([*failures, *soft.failures.values()])
            outcomes[kind] = Simulated(x, cast(np.ndarray, soft.gradient)[0][:, start.components], text)
        yield target, outcomes


def mass_of(scene: Scene, x: np.ndarray) -> np.ndarray:
    """Mass tensor of particle positions."""
    return spread_mass(x, scene.grid_size, scene.particle_mass, scene.floor_stencil)


def compare(
    configurations: Sequence[Start], device: str = "cpu", deterministic: bool = False
) -> Iterator[dict[str, object]]:
    """Run all configurations in both precisions; yield a row of :data:`COLUMNS` per configuration and kind of
    actions.

    The target is the final state of the demonstration in float64; for simulated targets this is the task's
    own.

    Args:
        configurations: The configurations.
        device: ``cpu`` or ``cuda``, for both.
        deterministic: Whether float32 sums use integers on CUDA, see ``sim.deterministic``.
    """
    exact = list(run(configurations, None, precision="float64", device=device))
    targets = [target for target, _ in exact]
    rounded = run(configurations, targets, precision="float32", device=device, deterministic=deterministic)
    with np.errstate(invalid="ignore"):
        yield from _rows(configurations, exact, rounded)


def _rows(configurations: Sequence[Start], exact: Sequence, rounded: Iterator) -> Iterator[dict[str, object]]:
    for start, (target, right), (_, got) in zip(configurations, exact, rounded, strict=True):
        initial = mass_of(start.scene, sample_particles(start.scene))
        for kind in start.actions:
            a, b = got[kind], right[kind]
            masses = [mass_of(start.scene, o.x) for o in (a, b)]
            at = [scores(initial, mass, target).score for mass in masses]
            norm = np.linalg.norm(b.gradient)
            yield {
                "task": start.task,
                "variant": start.variant,
                "actions": kind,
                "score_float32": round(at[0], 5),
                "score_float64": round(at[1], 5),
                "difference": f"{at[0] - at[1]:.1e}",
                "positions_rms": f"{np.sqrt(((a.x - b.x) ** 2).sum(axis=1).mean()):.1e}",
                "mass_l1": f"{np.abs(masses[0] - masses[1]).sum() / masses[1].sum():.1e}",
                "gradient_norm": f"{norm:.3g}",
                "norm_ratio": f"{np.linalg.norm(a.gradient) / norm:.6f}",
                "angle_deg": f"{angle(a.gradient, b.gradient):.2g}",
                "failures": " / ".join(o.failures for o in (a, b) if o.failures),
            }


@command_line
def main(argv: Sequence[str]) -> None:
    """Compare float32 with float64, print rows, and write the requested files."""
    parser = Parser("precision", __doc__)
    parser.prog = "python benchmarks/precision.py"
    parser.add_argument("--task", nargs="+", choices=suite_tasks(), default=suite_tasks(), help="tasks")
    parser.add_argument("--variant", nargs="+", default=list(SUITE_VARIANTS), help="variants")
    parser.add_argument("--particles", type=positive, default=1000, help="particles per environment")
    parser.add_argument("--device", choices=DEVICES, default="cpu", help="cpu or cuda")
    parser.add_argument("--deterministic", action="store_true", help="sums of integers in float32, on CUDA")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    parser.add_argument("--markdown", type=to_write, help="file to write a table to, a row per task")
    options = parser.parse_intermixed_args(argv)
    configurations = starts(options.task, options.variant, options.particles)
    rows = compare(configurations, options.device, options.deterministic)
    table = measure_table(COLUMNS, rows, options.csv)
    if options.markdown is not None:
        worst = precision_summary(pd.DataFrame(table))
        heading = f"float32 against float64, {options.particles} particles, 50 steps.\n\n"
        lines = ["| " + " | ".join(worst.columns) + " |", "|" + "---|" * len(worst.columns)]
        lines += ["| " + " | ".join(map(str, row)) + " |" for row in worst.itertuples(index=False)]
        options.markdown.parent.mkdir(parents=True, exist_ok=True)
        options.markdown.write_text(heading + "\n".join(lines) + "\n", encoding="utf-8")


def precision_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return the maximum and median difference of float32 from float64, per task and kind of actions, from
    the table of :func:`compare`."""
    score, turn = table["difference"].astype(float).abs(), table["angle_deg"].astype(float)
    groups = table.assign(score=score, turn=turn, failed=table["failures"].fillna("").ne("")).groupby(
        ["task", "actions"], sort=False
    )
    columns = {
        "configurations": groups.size(),
        "largest difference of scores": groups["score"].max().map("{:.1e}".format),
        "median": groups["score"].median().map("{:.1e}".format),
        "largest angle of gradients [deg]": groups["turn"].max().map("{:.2g}".format),
        "median angle [deg]": groups["turn"].median().map("{:.2g}".format),
        "failures": groups["failed"].sum(),
    }
    return pd.DataFrame(columns).replace("nan", "-").reset_index()


if __name__ == "__main__":
    sys.exit(main())
