"""Stress test of the simulator: extreme cases, and scenes that the simulator must reject.

    python benchmarks/stress.py                         # everything, in both precisions
    python benchmarks/stress.py --quick                 # a few minutes on two cores
    python benchmarks/stress.py --precision float32 --particles 1000 --csv cases.csv
    python benchmarks/stress.py --quick --family "1000 steps" --gradients norms.csv

In addition to the suite's configurations, as in ``plab bench stability``, cases have extreme materials, or
bodies that are crushed, thrown at walls, overlapping, inverted or flat. :mod:`plab.bench.stability` defines
survival; scenes that cannot be simulated must be rejected with the reason, and come last. All cases with one
kind of scene share a compiled simulator, see ``common_scene.py``. With ``--gradients`` the norm of the
gradient at each step back in time is written, and plotted in a PNG of the same name.
"""

from __future__ import annotations

import functools
import itertools
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from common_scene import common_actions, common_scene
from plab.bench.stability import ACTIONS, COLUMNS, stress, stress_simulator, summarise
from plab.cli.command import Parser, command_line, measure_table, positive, to_write
from plab.config import ConfigError, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.scenes import PRECISIONS, Body, Manipulator, Scene, SceneError, Vec3, vector3

STEP_TIME = 19e-4
"""Simulated time of an environment step of the suite [s]."""

DEFORMED = 512
"""Substeps per environment step of bodies that start strongly deformed."""

LABELLED = 12
"""Largest number of cases for a legend in the figure of norms, because colours repeat."""


BATCH = 12
"""Environments simulated together."""


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
    variants: tuple[str, ...]
    long_tasks: tuple[str, ...]
    long_horizon: int
    horizon: int = 50


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
        contact_weight: Weight of the contact term of the loss.
    """

    family: str
    name: str
    scene: Scene
    actions: np.ndarray
    contact: str
    state: Mapping[str, np.ndarray] = field(default_factory=dict)
    contact_weight: float = 0.0


def run_cases(cases: Sequence[StressCase], precision: str) -> Iterator[dict[str, object]]:
    """Run cases in a precision, ``float32`` or ``float64``; cases with one kind of scene share a compiled
    simulator. Yield a row of :data:`plab.bench.stability.COLUMNS` per case, and ``norms``."""
    groups: dict[tuple, list[StressCase]] = defaultdict(list)
    for case in cases:
        scene, shapes = case.scene, tuple(m.shape for m in case.scene.manipulators)
        kind = (shapes, scene.particle_count, scene.grid_size, scene.dt, scene.substeps)
        groups[(*kind, len(case.actions), case.contact_weight)].append(case)
    for group in groups.values():
        size = min(BATCH, len(group))
        simulator = stress_simulator([group[0].scene] * size, precision, group[0].contact_weight)
        for at in range(0, len(group), size):
            some = group[at : at + size]
            full = [*some, *([some[-1]] * (size - len(some)))]
            simulator.set_scenes([case.scene for case in full])
            simulator.set_contact([case.contact for case in full])
            start = simulator.state()
            for e, case in enumerate(full):
                for name, value in case.state.items():
                    getattr(start, name)[e] = value
            simulator.set_initial_state(start)
            for case, found in zip(
                some, stress(simulator, np.stack([c.actions for c in full])), strict=False
            ):
                yield {"precision": precision, "family": case.family, "case": case.name, **found}
        # Release the memory of the simulator before building the next one.
        del simulator


def stress_cases(plan: StressPlan) -> list[StressCase]:
    """Return all cases of a plan."""
    families = (suite_actions, materials, crushing, walls, overlaps, deformations, stiff, few_particles)
    return [case for family in families for case in family(plan)]


@functools.cache
def task_scene(task: str, variant: str) -> Scene:
    """Return the scene of a configuration of the suite."""
    return build_scene(load_config([f"task={task}", f"variant={variant}"]))


def common_case(
    plan: StressPlan,
    family: str,
    name: str,
    scene: Scene,
    actions: np.ndarray,
    contact: str,
    **state: np.ndarray,
) -> StressCase:
    """Return a case in the common kind of scene, given a scene and its actions."""
    common, actions = common_scene(scene, plan.particles), common_actions(scene, actions)
    return StressCase(family, name, common, actions, contact, state)


def suite_actions(plan: StressPlan) -> Iterator[StressCase]:
    """Return all configurations under random and bang-bang actions, in both contact models; some over the
    long horizon."""
    short = itertools.product(["suite"], suite_tasks(), plan.variants, ACTIONS, ("soft", "hard"))
    family = f"{plan.long_horizon} steps"
    long = itertools.product([family], plan.long_tasks, ["1"], ACTIONS, ("soft", "hard"))
    numbered = itertools.chain(enumerate(short), enumerate(long, start=1000))
    for number, (family, task, variant, kind, contact) in numbered:
        scene = task_scene(task, variant)
        steps = plan.horizon if family == "suite" else plan.long_horizon
        own = ACTIONS[kind](np.random.default_rng(number), steps, scene.action_dim)
        yield common_case(plan, family, f"{task}-v{variant} {kind} {contact}", scene, own, contact)


def box_scene(*manipulators: Manipulator, center: Vec3 = (0.5, 0.1, 0.5), **changes: Any) -> Scene:
    """Return a cube of plasticine with edge 0.2, on the floor unless moved."""
    values: dict[str, Any] = {"substeps": 19, "dt": STEP_TIME / 19, **changes}
    return Scene("cube", (Body("box", center, (0.2,) * 3, 1000),), manipulators, **values)


def sphere(*position: float) -> Manipulator:
    """Return a ball manipulator, slightly faster than in the tasks."""
    return Manipulator("Sphere", (0.04,), vector3(position), scale=(0.03,) * 3)


def squeezing(plan: StressPlan) -> tuple[tuple[Manipulator, ...], np.ndarray]:
    """Return two balls at the sides of the cube, and actions that press them together and pull them apart."""
    wave = np.where(np.arange(plan.horizon) % 24 < 12, 1.0, -1.0)
    actions = np.zeros((plan.horizon, 6))
    actions[:, 0], actions[:, 3] = wave, -wave
    return (sphere(0.36, 0.1, 0.5), sphere(0.64, 0.1, 0.5)), actions


def materials(plan: StressPlan) -> Iterator[StressCase]:
    """Return cubes with yield stresses from zero to infinite, Poisson ratios up to the limit of the suite's
    time step, and extreme E."""
    tools, actions = squeezing(plan)
    for young, nu, flow in itertools.product(
        (50.0, 5000.0), (0.0, 0.2, 0.35), (0.0, 1.0, 50.0, 1e4, math.inf)
    ):
        scene = box_scene(*tools, youngs_modulus=young, poisson_ratio=nu, yield_stress=flow)
        name = f"E {young:g}, nu {nu:g}, yield stress {flow:g}"
        yield common_case(plan, "material", name, scene, actions, "soft")


def stiff(plan: StressPlan) -> Iterator[StressCase]:
    """Return materials that need all of the given substeps: E times 100, and nu up to 0.49."""
    tools, actions = squeezing(plan)
    substeps = math.ceil(STEP_TIME / replace(box_scene(), youngs_modulus=5e5).stable_dt)
    time_step: dict[str, Any] = {"substeps": substeps, "dt": STEP_TIME / substeps}
    kinds = itertools.product((0.2, 0.45, 0.49), (0.0, 50.0, 1e4, math.inf), ("soft", "hard"))
    for nu, flow, contact in kinds:
        scene = box_scene(*tools, poisson_ratio=nu, yield_stress=flow, **time_step)
        # The stability limit falls with the root of E.
        limit = scene.youngs_modulus * (scene.stable_dt / scene.dt) ** 2
        scene = replace(counted(scene, plan.particles), youngs_modulus=0.9999 * limit)
        name = f"E {limit:.0f}, nu {nu:g}, yield stress {flow:g}, {contact}"
        yield StressCase("stiff", name, scene, actions[:10], contact, contact_weight=1.0)


def counted(scene: Scene, particles: int, **changes: Any) -> Scene:
    """Return a scene with one body with a given number of particles and other changes."""
    return replace(scene, bodies=(replace(scene.bodies[0], particles=particles, **changes),))


def crushing(plan: StressPlan) -> Iterator[StressCase]:
    """Return manipulators that crush the cube against the floor or each other, and stay there."""
    lying = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
    thin, six = (0.03,) * 3, np.concatenate([np.eye(3), -np.eye(3)])
    pin = Manipulator("RollingPin", (0.3, 0.04), (0.5, 0.25, 0.5), lying, scale=(0.7, 0.07, 0.01))
    pair = (*(0.02,) * 3, *(0.04,) * 3, 0.02)
    sticks = Manipulator("Chopsticks", (0.2, 0.02), (0.5, 0.25, 0.5), scale=pair, gap=0.24)
    block = Manipulator("Box", (0.08, 0.05, 0.08), (0.5, 0.26, 0.5), scale=(*thin, *(0.04,) * 3))
    pillar = Manipulator("Cylinder", (0.1, 0.3), (0.29, 0.1, 0.5))
    scenes: dict[str, tuple[Sequence[Manipulator], Sequence[float]]] = {
        "Sphere": ([sphere(0.5, 0.25, 0.5)], (0, -1, 0)),
        "Capsule": ([Manipulator("Capsule", (0.06, 0.04), (0.5, 0.3, 0.5), scale=thin)], (0, -1, 0)),
        "RollingPin": ([pin], (0.5, 0.2, -1)),
        "Chopsticks": ([sticks], (0, -0.3, 0, 0, 0, 0, 1)),
        "Torus": ([Manipulator("Torus", (0.05, 0.03), (0.5, 0.25, 0.5), scale=thin)], (0, -1, 0)),
        "Box": ([block], (0, -1, 0, 0, 0.5, 0)),
        "two balls": ([sphere(0.36, 0.1, 0.5), sphere(0.64, 0.1, 0.5)], (1, 0, 0, -1, 0, 0)),
        "ball and pillar": ([sphere(0.65, 0.1, 0.5), pillar], (-1, 0, 0)),
        "six balls": (
            [sphere(0.5 + dx, 0.12 + dy, 0.5 + dz) for dx, dy, dz in six * 0.15],
            (-six.reshape(-1)).tolist(),
        ),
    }
    for (name, (used, action)), flow, contact in itertools.product(
        scenes.items(), (50.0, math.inf), ("soft", "hard")
    ):
        scene = box_scene(*used, yield_stress=flow)
        held = np.tile(np.array(action, float), (plan.horizon, 1))
        yield common_case(plan, "crush", f"{name}, yield stress {flow:g}, {contact}", scene, held, contact)


def walls(plan: StressPlan) -> Iterator[StressCase]:
    """Return cubes thrown and pushed into walls and corners."""
    for number, direction in enumerate(itertools.product((-1.0, 0.0, 1.0), repeat=3)):
        if not any(direction):
            continue
        speed = 40.0 * np.array(direction)
        scene = box_scene(center=(0.45, 0.4, 0.45), yield_stress=math.inf if number % 2 else 50.0)
        name, still = f"thrown along {direction}", np.zeros((plan.horizon, 0))
        yield common_case(plan, "walls", name, scene, still, "hard", v=np.tile(speed, (plan.particles, 1)))
    for corner, contact in itertools.product(itertools.product((0.12, 0.8), repeat=2), ("soft", "hard")):
        place = (corner[0], 0.1, corner[1])
        inwards = np.array([0.5 - corner[0], 0.0, 0.5 - corner[1]])
        scene = box_scene(sphere(*(np.array(place) + 0.4 * inwards)), center=place)
        push = np.tile(-np.sign(inwards), (plan.horizon, 1))
        yield common_case(plan, "walls", f"pushed into {place}, {contact}", scene, push, contact)


def overlaps(plan: StressPlan) -> Iterator[StressCase]:
    """Return overlapping bodies, manipulators inside a body, and all particles at one point."""
    cube = Body("box", (0.5, 0.3, 0.5), (0.2,) * 3, 1000)
    ball = Body("sphere", (0.55, 0.35, 0.5), (0.12,), 1000)
    tools, actions = squeezing(plan)
    inside = (sphere(0.5, 0.3, 0.5), sphere(0.52, 0.3, 0.5))
    near = replace(cube, center=(0.5, 0.1, 0.5)), replace(ball, center=(0.55, 0.15, 0.5))
    starts: dict[str, tuple[tuple[Body, ...], tuple[Manipulator, ...]]] = {
        "two bodies": ((cube, ball), ()),
        "the same body twice": ((cube, cube), ()),
        "manipulators in the body and in each other": ((cube,), inside),
        "bodies between manipulators": (near, tools),
    }
    places = {
        "all particles at one point": np.tile([0.5, 0.3, 0.5], (plan.particles, 1)),
        "all particles in a corner": np.zeros((plan.particles, 3)),
        "all particles in the upper corner": np.full((plan.particles, 3), 1.0 - 3.0 / 64),
        "all particles on a line": np.linspace([0.3, 0.3, 0.3], [0.7, 0.3, 0.3], plan.particles),
    }
    for name, contact in itertools.product((*starts, *places), ("soft", "hard")):
        bodies, used = starts.get(name, ((cube,), ()))
        scene = replace(box_scene(*used), bodies=bodies)
        own = actions if used else np.zeros((plan.horizon, 0))
        state = {"x": places[name]} if name in places else {}
        yield common_case(plan, "overlap", f"{name}, {contact}", scene, own, contact, **state)


def deformations(plan: StressPlan) -> Iterator[StressCase]:
    """Return initial deformation gradients that are inverted, singular, tiny or huge, with and without flow.

    They store a lot of energy, and the material stiffens during release, hence the substeps.
    """
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(plan.particles, 3, 3)))[0]
    shapes = {
        "inverted along one axis": np.diag([1.0, 1.0, -1.0]),
        "inverted and stretched": np.diag([1.3, 0.7, -0.9]),
        "turned inside out": -np.eye(3),
        "rank two": np.diag([1.0, 1.0, 0.0]),
        "rank one": np.diag([1.0, 0.0, 0.0]),
        "zero": np.zeros((3, 3)),
        "all singular values 1e-3": 1e-3 * np.eye(3),
        "all singular values 3": 3.0 * np.eye(3),
        "flat": np.diag([5.0, 5.0, 0.04]),
        "rod": np.diag([25.0, 0.2, 0.2]),
    }
    tools, actions = squeezing(plan)
    for (name, shape), flow in itertools.product(shapes.items(), (0.0, 50.0, math.inf)):
        scene = box_scene(*tools, yield_stress=flow, substeps=DEFORMED, dt=STEP_TIME / DEFORMED)
        scene, state = counted(scene, plan.particles), {"F": turn @ shape @ turn.transpose(0, 2, 1)}
        title = f"{name}, yield stress {flow:g}"
        yield StressCase("deformation", title, scene, actions[:3], "soft", state, contact_weight=1.0)


def few_particles(plan: StressPlan) -> Iterator[StressCase]:
    """Return a single particle, and a handful."""
    tools, actions = squeezing(plan)
    for count, flow, contact in itertools.product((1, 5), (50.0, math.inf), ("soft", "hard")):
        scene = counted(box_scene(*tools, yield_stress=flow), count, size=(0.02,) * 3)
        name = f"{count} particle(s), yield stress {flow:g}, {contact}"
        yield StressCase("few particles", name, scene, actions, contact, contact_weight=1.0)


def refusals() -> dict[str, Scene]:
    """Return scenes that cannot be simulated, by reason."""
    nan, inf = math.nan, math.inf
    tool = sphere(0.5, 0.3, 0.5)
    scene = box_scene(tool)

    def with_body(**changes: Any) -> Scene:
        return replace(scene, bodies=(replace(scene.bodies[0], **changes),))

    def with_tool(**changes: Any) -> Scene:
        return replace(scene, manipulators=(replace(tool, **changes),))

    return {
        "E times 100 without more substeps": replace(scene, youngs_modulus=5e5),
        "nu 0.49 without more substeps": replace(scene, poisson_ratio=0.49),
        "a finer grid without more substeps": replace(scene, grid_size=256),
        "incompressible": replace(scene, poisson_ratio=0.5),
        "auxetic": replace(scene, poisson_ratio=-0.2),
        "no stiffness": replace(scene, youngs_modulus=0.0),
        "E is NaN": replace(scene, youngs_modulus=nan),
        "infinite E": replace(scene, youngs_modulus=inf),
        "negative yield stress": replace(scene, yield_stress=-1.0),
        "yield stress is NaN": replace(scene, yield_stress=nan),
        "negative floor friction": replace(scene, floor_friction=-1.0),
        "floor friction is NaN": replace(scene, floor_friction=nan),
        "gravity is NaN": replace(scene, gravity=(0.0, nan, 0.0)),
        "gravity of a cell per substep": replace(scene, gravity=(0.0, -2e6, 0.0)),
        "no substeps": replace(scene, substeps=0),
        "time step 0": replace(scene, dt=0.0),
        "time step is NaN": replace(scene, dt=nan),
        "grid too coarse": replace(scene, grid_size=4),
        "no bodies": replace(scene, bodies=()),
        "no particles": with_body(particles=0),
        "body outside the domain": with_body(center=(0.95, 0.1, 0.5)),
        "body's centre is NaN": with_body(center=(nan, 0.1, 0.5)),
        "flat body": with_body(size=(0.2, 0.0, 0.2)),
        "body's size is NaN": with_body(size=(0.2, nan, 0.2)),
        "unknown body": with_body(shape="cone"),
        "unknown manipulator": with_tool(shape="Cone"),
        "manipulator of no size": with_tool(size=(0.0,)),
        "manipulator's size is NaN": with_tool(size=(nan,)),
        "manipulator's position is NaN": with_tool(position=(nan, 0.3, 0.5)),
        "manipulator's rotation is not a rotation": with_tool(rotation=(2.0, 0.0, 0.0, 0.0)),
        "manipulator's friction is NaN": with_tool(friction=nan),
        "manipulator's scale is NaN": with_tool(scale=(nan, 0.0, 0.0)),
        "manipulator moves by cells per substep": with_tool(scale=(1.0, 0.0, 0.0)),
        "manipulator's bounds are the wrong way round": with_tool(
            lower_bound=(0.9, 0.0, 0.0), upper_bound=(0.1, 1.0, 1.0)
        ),
    }


def run_refusals() -> Iterator[dict[str, object]]:
    """Check that scenes that cannot be simulated are rejected.

    Yields:
        A row of :data:`plab.bench.stability.COLUMNS` per scene; ``where`` is the message.
    """
    for name, scene in refusals().items():
        outcome, message = "was not refused", ""
        try:
            scene.validate()
        except SceneError as error:
            outcome, message = "survived", str(error)
        yield dict(zip(COLUMNS, ("any", "refusal", name, outcome, "", "", message), strict=True))


def write_norms(rows: Sequence[Mapping[str, object]], path: Path) -> None:
    """Write and plot the norm of the gradient at each step back in time.

    Args:
        rows: Rows of :func:`run_cases`.
        path: CSV file; the plot is a PNG of the same name.
    """
    from plab.report.figures import legend, single, style

    parts = [
        (row["precision"], row["family"], row["case"], cast(np.ndarray, row["norms"])[::-1]) for row in rows
    ]
    table = [(*which, back, norm) for *which, norms in parts for back, norm in enumerate(norms)]
    columns = ["precision", "family", "case", "back", "norm"]
    pd.DataFrame(table, columns=columns).to_csv(path, index=False, float_format="%.6g")
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
        panel.set(yscale="log", ylabel="norm of a step's gradient")
        if len(colours) <= LABELLED:
            legend(figure, columns=3)
        figure.savefig(path.with_suffix(".png"))
    print(path.with_suffix(".png"))


@command_line
def main(argv: Sequence[str]) -> int:
    """Simulate the cases, print rows, and write the requested files; return the exit code."""
    parser = Parser("stress", __doc__)
    parser.prog = "python benchmarks/stress.py"
    parser.add_argument(
        "--gradients", type=to_write, help="file for the gradient's norm per step back in time"
    )
    parser.add_argument("--quick", action="store_true", help="one variant of each task, fewer particles")
    parser.add_argument("--precision", choices=PRECISIONS, nargs="+", default=list(PRECISIONS))
    parser.add_argument("--particles", type=positive, help="particles per environment (300; 64 with --quick)")
    parser.add_argument(
        "--horizon", type=positive, default=1000, help="environment steps of long cases (1000)"
    )
    parser.add_argument("--family", nargs="+", help="families of cases")
    parser.add_argument("--csv", type=to_write, help="file to write a row per case to")
    options = parser.parse_intermixed_args(argv)
    variants, tasks = (SUITE_VARIANTS[:1], ("Move",)) if options.quick else (SUITE_VARIANTS, suite_tasks())
    particles = options.particles or (64 if options.quick else 300)
    cases = stress_cases(StressPlan(particles, variants, tuple(tasks), options.horizon))
    families = list(dict.fromkeys(case.family for case in cases))
    if unknown := set(options.family or ()) - set(families):
        raise ConfigError(f"no cases of {', '.join(sorted(unknown))}; choose from: {', '.join(families)}")
    chosen = [case for case in cases if case.family in (options.family or families)]
    each = (run_cases(chosen, precision) for precision in options.precision)
    table = measure_table(COLUMNS, itertools.chain.from_iterable(each), options.csv)
    if options.gradients is not None:
        write_norms(table, options.gradients)
    refused = [] if options.family else measure_table(COLUMNS, run_refusals(), None)
    return summarise([*table, *refused])


if __name__ == "__main__":
    sys.exit(main())
