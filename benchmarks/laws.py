"""Constitutive laws compared with theory and experiments: collapses, slopes, slumps, viscosity, pressure.

    python benchmarks/laws.py
    python benchmarks/laws.py swirl slump

prints a line per case and resolution: the simulated value and the value from theory or experiments. Bodies
stand in a corner of the domain, whose walls are planes of symmetry; slabs and columns have frictionless
walls. The time step is 0.8 times the largest stable one.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import j1, jn_zeros

from plab.scenes import MATERIAL_KEYS, Body, Manipulator, Scene
from plab.sim import Simulator, State

GRAVITY = 30.0

SUBSTEPS = 20
"""Substeps per environment step."""

WALL = 2
"""Position of walls and floor [cells], where bodies begin."""

PARTICLES = 2
"""Particles per cell and axis."""

THICKNESS = 4
"""Thickness of a slab [cells]."""

Row = tuple[str, float, float]
"""Quantity, simulated value, and value from theory or experiments."""


def lattice(x: int, y: int, z: int) -> np.ndarray:
    """Particles of a box of cells [cells], shape [particle, 3]."""
    axes = [(np.arange(PARTICLES * count) + 0.5) / PARTICLES for count in (x, y, z)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def cylinder(radius: int, height: int) -> np.ndarray:
    """Particles of a quarter of a cylinder about the y axis [cells], shape [particle, 3]."""
    box = lattice(radius, height, radius)
    return box[np.hypot(box[:, 0], box[:, 2]) < radius]


SAND = {"poisson_ratio": 0.2, "friction_angle": 25.0}

FRICTION = 2.0 * math.sqrt(3.0) * math.sin(math.radians(25.0)) / (3.0 - math.sin(math.radians(25.0)))
"""Ratio of shear stress to pressure of this sand in simple shear: the tangent of 29.6 degrees."""


class Run:
    """A body with one law in a corner of the domain, or a slab or column of it between walls.

    Attributes:
        scene: The scene.
        simulator: The simulator.
        time: Current time [s].
    """

    def __init__(self, law: str, values: dict[str, float], x: np.ndarray, grid: int, **scene: Any) -> None:
        """Place particles [cells] in a domain of ``grid`` cells; ``scene`` are fields of the scene."""
        self._cell, self.time = 1.0 / grid, 0.0
        own = {key: values[key] for key in MATERIAL_KEYS if key in values}
        others = {key: value for key, value in values.items() if key not in own}
        body = Body("box", (0.5,) * 3, (0.1,) * 3, len(x), law=law, **own, parameters=others)
        behind = 0.25 + (WALL + THICKNESS) * self._cell
        walls = tuple(
            Manipulator(
                "Box",
                (0.25, 2.0, 2.0) if axis == 0 else (2.0, 2.0, 0.25),
                (behind, 0.5, 0.5) if axis == 0 else (0.5, 0.5, behind),
                scale=(0.0,) * 6,
                friction=0.0,
            )
            for axis in (0, 2)
            if x[:, axis].max() < THICKNESS
        )
        made = {
            "gravity": (0.0, -GRAVITY, 0.0),
            "floor_friction": 100.0,
            "grid_size": grid,
            "substeps": SUBSTEPS,
            **scene,
        }
        built = Scene("law", (body,), walls, **made)
        self.scene = replace(built, dt=0.8 * built.stable_dt)
        self.simulator = Simulator([self.scene], particles=[self._cell * (x + WALL)])
        self.simulator.set_contact("hard")

    @property
    def x(self) -> np.ndarray:
        """Positions from the corner [cells], shape [particle, 3]."""
        return self.simulator.state().x[0] / self._cell - WALL

    def go(self, seconds: float) -> State:
        """Advance to a time [s]."""
        while self.time < seconds:
            self.simulator.step(np.zeros((1, self.scene.action_dim)))
            self.time += self.scene.substeps * self.scene.dt
        return self.simulator.state()

    def top(self) -> float:
        """Height [cells]."""
        return float(np.quantile(self.x[:, 1], 0.999)) + 0.5 / PARTICLES


def collapse(radius: int) -> Iterator[Row]:
    """Collapse of a sand column with height equal to radius: run-out after Lube et al. (2004), grains with a
    repose angle of 30 degrees; height of glass beads after Lajeunesse et al. (2004)."""
    values = {**SAND, "youngs_modulus": 200.0 * GRAVITY / 4.0}
    run = Run("drucker_prager", values, cylinder(radius, radius), 4 * radius)
    run.go(4.5 * math.sqrt(0.25 / GRAVITY))
    r, edges = np.hypot(run.x[:, 0], run.x[:, 2]), np.arange(3 * radius)
    area = 0.25 * math.pi * (edges[1:] ** 2 - edges[:-1] ** 2)
    thickness = np.histogram(r, edges)[0] / PARTICLES**3 / area
    front = edges[1:][thickness > 0.5].max()
    yield "run-out / radius, to half a cell's thickness", front / radius - 1.0, 1.24
    yield "height / radius", run.top() / radius, 0.74


def slope(cells: int) -> Iterator[Row]:
    """Acceleration of a layer of sand on a rough, tilted floor, compared with g (sin beta - mu cos beta)."""
    for tilt in (25.0, 36.0):
        sine, cosine = math.sin(math.radians(tilt)), math.cos(math.radians(tilt))
        values = {**SAND, "youngs_modulus": 500.0 * GRAVITY / 18.0}
        gravity = (GRAVITY * sine, -GRAVITY * cosine, 0.0)
        x = lattice(16 * cells, cells, THICKNESS)
        run = Run("drucker_prager", values, x, 18 * cells, gravity=gravity)
        # Both ends slide in any case.
        middle = (run.x[:, 1] > 0.75 * cells) & (np.abs(run.x[:, 0] - 5 * cells) < cells)
        speed = [(run.go(seconds).v[0, middle, 0].mean() / GRAVITY, run.time) for seconds in (0.1, 0.2)]
        rate = (speed[1][0] - speed[0][0]) / (speed[1][1] - speed[0][1])
        yield f"acceleration / g, {tilt:g} degrees", rate, max(sine - FRICTION * cosine, 0.0)


def swirl(radius: int) -> Iterator[Row]:
    """Decay rate of the swirl J1(k r), k R = 5.1356, in a free cylinder of fluid, compared with eta k^2."""
    k = jn_zeros(2, 1)[0] / radius
    signs = np.array([[1, 1, 1], [-1, 1, 1], [1, 1, -1], [-1, 1, -1]])
    x = np.concatenate([cylinder(radius, radius) * sign for sign in signs])
    r = np.hypot(x[:, 0], x[:, 2])
    mode = (j1(k * r) / r)[:, None] * x[:, [2, 1, 0]] * [-1.0, 0.0, 1.0]
    # An e-fold takes few steps, each of which damps the mode a little by itself.
    rate = 300.0 / radius
    values = {"bulk_modulus": 100.0, "viscosity": rate / (4 * k * radius) ** 2}
    centre = np.array([1.5, 0.5, 1.5]) * radius
    run = Run("fluid", values, x + centre, 4 * radius, gravity=(0.0, 0.0, 0.0), substeps=1)
    run.simulator.set_state(replace(run.simulator.state(), v=1e-2 * mode[None]))
    left = [((run.go(t / rate).v[0] * mode).sum(), run.time) for t in (0.2, 1.2)]
    yield "rate of decay / eta k^2", math.log(left[0][0] / left[1][0]) / (left[1][1] - left[0][1]) / rate, 1.0


def layer(height: int) -> Iterator[Row]:
    """Pressure gradient in a layer of fluid at rest, compared with rho g."""
    grid = height + 8
    values = {"bulk_modulus": 500.0 * GRAVITY, "viscosity": 0.1}
    run = Run("fluid", values, lattice(THICKNESS, height, THICKNESS), grid)
    start = run.simulator.state()
    depth = (height - run.x[:, 1]) / grid
    stretch = np.ones((len(depth), 3))
    stretch[:, 0] -= depth / 500.0
    run.simulator.set_state(replace(start, F=(np.eye(3) * stretch[:, None])[None]))
    volume = np.linalg.det(run.go(2.0 * math.sqrt(height / grid / GRAVITY)).F[0])
    inner = np.abs(run.x[:, 1] / height - 0.5) < 0.4
    gradient = np.polyfit(run.x[inner, 1] / grid, 500.0 * (volume[inner] - 1.0), 1)[0]
    yield "gradient of pressure / rho g", gradient, 1.0


def dam(width: int) -> Iterator[Row]:
    """Position of the front after the break of a dam twice as high as wide, after Martin and Moyce (1952)."""
    edge = 1.0 / 6.0
    values = {"bulk_modulus": 400.0 * GRAVITY * edge, "viscosity": 1e-4}
    run = Run("fluid", values, lattice(width, 2 * width, THICKNESS), 6 * width, floor_friction=0.0)
    unit, front = math.sqrt(edge / (2.0 * GRAVITY)), []
    for scaled in (1.997, 3.345):
        run.go(scaled * unit)
        front.append((float(np.quantile(run.x[:, 0], 0.999)) / width, run.time / unit))
    yield "front / width at 3.345 sqrt(width / 2 g)", front[1][0], 4.134
    speed = (front[1][0] - front[0][0]) / (front[1][1] - front[0][1])
    yield "its speed / sqrt(2 g width), from 1.997 on", speed, (4.134 - 2.292) / (3.345 - 1.997)


def slump(height: int) -> Iterator[Row]:
    """Slump of a Bingham cylinder with height equal to radius, after Pashias et al. (1996)."""
    weight = GRAVITY / 4.0
    for share in (0.6, 0.2, 0.1):
        flow = {"yield_stress": math.sqrt(2.0) * share * weight, "consistency": 0.002 * weight}
        values = {"youngs_modulus": 100.0 * weight, "poisson_ratio": 0.3, **flow}
        run = Run("viscoplastic", values, cylinder(height, height), 4 * height)
        run.go(4.0 * math.sqrt(0.25 / GRAVITY))
        carried = min(2.0 * share, 1.0)
        theory = 1.0 - carried * (1.0 - math.log(carried))
        yield f"slump / height, yield stress {share} rho g H", 1.0 - run.top() / height, theory


CASES: dict[str, tuple[Callable[[int], Iterator[Row]], tuple[int, ...]]] = {
    "collapse": (collapse, (12, 20, 32)),
    "slope": (slope, (6,)),
    "swirl": (swirl, (8, 16)),
    "layer": (layer, (8, 16)),
    "dam": (dam, (16,)),
    "slump": (slump, (8, 16)),
}
"""Cases and their resolutions [cells]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="*", help=", ".join(CASES))
    parser.add_argument("--cells", type=int, nargs="+", help="resolutions, instead of each case's own")
    options = parser.parse_args()
    for name in options.case or CASES:
        case, cells = CASES[name]
        for count in options.cells or cells:
            begin = time.perf_counter()
            for what, value, wanted in case(count):
                print(f"{name:9} {count:3} cells  {what:45} {value:8.3f} {wanted:8.3f}", flush=True)
            print(f"{'':9} {time.perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
