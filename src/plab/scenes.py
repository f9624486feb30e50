"""Scenes: plasticine bodies, materials, manipulators, floor, cameras and particle sampling.

A :class:`Scene` is plain data in SI-like units inside the unit cube (y is up). It does not depend on Taichi,
Hydra or Gymnasium, and is the input of the simulator, the reference implementation of the tests and the
target recipes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.errors import PlabError
from plab.laws import Law
from plab.laws.elastic import lame
from plab.mesh import Mesh, load_mesh
from plab.plugins import Registry, scipy

if TYPE_CHECKING:
    from plab.kinematics import Chain

CONVENTIONS = ("plab", "release")
"""Reference implementation whose convention applies: plab's own, or the PlasticineLab release's."""

DEVICES = ("cpu", "cuda")
"""Devices for simulation."""

PRECISIONS = ("float32", "float64")
"""Floating-point types of the simulation."""

CONTACTS = ("soft", "hard")
"""Contact models of manipulators and particles."""


# ------------------------------------------------------------------------------------------------- bodies

BODY_SHAPES = ("sphere", "box", "mesh")
"""Values of :attr:`Body.shape`."""

MATERIAL_KEYS = ("youngs_modulus", "poisson_ratio", "yield_stress")
"""Material parameters that bodies inherit from their scene by default, as fields of a :class:`Material`."""

LAWS = Registry(
    Law,
    {
        name: f"plab.laws.{name}:{name.upper()}"
        for name in ("von_mises", "elastic", "drucker_prager", "fluid", "viscoplastic")
    },
)
"""plab's own laws by name."""

Vec3 = tuple[float, float, float]


def vector3(values: Sequence[float]) -> Vec3:
    """Return three numbers as a tuple; raise ValueError for any other length."""
    x, y, z = values
    return x, y, z


def find_law(name: str) -> Law:
    """Return a law by name, or an external law by ``module:NAME``; raise ConfigError if it is missing."""
    found: Law = LAWS.find(name, "law")
    return found


class SceneError(PlabError, ValueError):
    """Scene that cannot be simulated; the message has the reason and a valid value."""


@dataclass(frozen=True)
class Material:
    """Material of a body: a law and its parameters.

    Attributes:
        youngs_modulus: Young's modulus E.
        poisson_ratio: Poisson ratio nu.
        yield_stress: von Mises yield stress; ``inf`` for a purely elastic body.
        law: Name of the law, see :func:`find_law`.
        parameters: Other parameters of the law, by name; default: the law's.
    """

    youngs_modulus: float
    poisson_ratio: float
    yield_stress: float
    law: str = "von_mises"
    parameters: tuple[tuple[str, float], ...] = ()

    @property
    def kind(self) -> Law:
        """The law object."""
        return find_law(self.law)

    @property
    def values(self) -> dict[str, float]:
        """Values of the law's parameters, in order."""
        given = {key: getattr(self, key) for key in MATERIAL_KEYS} | dict(self.parameters)
        return {key: given.get(key, default) for key, default in self.kind.defaults.items()}

    @property
    def lame(self) -> tuple[float, float]:
        """Lame parameters mu and lambda."""
        return lame(self.youngs_modulus, self.poisson_ratio)

    def largest_step(self, dx: float) -> float:
        """Return the largest stable time step [s] on a grid of spacing dx."""
        try:
            return self.kind.largest_step(self.values, dx)
        except Exception as error:
            # A law of the user may raise anything.
            raise SceneError(f"law {self.law}: coefficients, stiffness or viscosity fail: {error}") from error

    def validate(self, label: str = "") -> None:
        """Raise SceneError, with a message that begins with ``label``, if a value is out of range."""
        known = [key for key in self.kind.keys if key not in MATERIAL_KEYS]
        for name in dict(self.parameters):
            if name not in known:
                only = ", ".join(known) or "none"
                raise SceneError(f"{label}parameters.{name} is not one of law {self.law} ({only}): remove it")
        for parameter in self.kind.parameters:
            value = self.values[parameter.name]
            if not parameter.admits(value):
                raise SceneError(f"{label}{parameter.name} {value:g} is outside {parameter.interval}")


@dataclass(frozen=True)
class Body:
    """A plasticine body, initially filled with uniformly sampled particles.

    Attributes are those of :class:`plab.config.BodyConfig`: ``shape``, ``center`` and ``size`` [domain
    units], ``particles``, and material parameters; parameters that are None are inherited from the scene.
    ``mesh`` is the mesh of a body of shape ``mesh``.
    """

    shape: str
    center: Vec3
    size: tuple[float, ...]
    particles: int
    youngs_modulus: float | None = field(default=None, kw_only=True)
    poisson_ratio: float | None = field(default=None, kw_only=True)
    yield_stress: float | None = field(default=None, kw_only=True)
    law: str | None = field(default=None, kw_only=True)
    parameters: Mapping[str, float] | tuple[tuple[str, float], ...] = field(default=(), kw_only=True)
    mesh: Mesh | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Convert the parameters to a hashable form."""
        object.__setattr__(self, "parameters", tuple(sorted(dict(self.parameters).items())))

    @property
    def own_material(self) -> dict[str, Any]:
        """:class:`Material` fields that differ from the scene's."""
        values = {key: getattr(self, key) for key in (*MATERIAL_KEYS, "law")}
        own = {key: value for key, value in values.items() if value is not None}
        return {**own, "parameters": self.parameters} if self.parameters else own

    def half_extent(self) -> np.ndarray:
        """Half edges of the bounding box, shape [3]."""
        if self.mesh is not None:
            return self.size[0] / 2 * self.mesh.extent
        return np.full(3, self.size[0]) if self.shape == "sphere" else np.asarray(self.size, dtype=float) / 2

    @property
    def volume(self) -> float:
        """Volume at t = 0 [domain units^3]."""
        if self.mesh is not None:
            return math.prod(self.size * 3) * self.mesh.volume
        return 4 / 3 * math.pi * math.prod(self.size * 3) if self.shape == "sphere" else math.prod(self.size)


def make_body(
    shape: str,
    center: Sequence[float],
    size: Sequence[float],
    particles: int,
    file: str | None = None,
    sha256: str | None = None,
    **material: Any,
) -> Body:
    """Create a body from a configuration, and read its mesh file, if any.

    Arguments are fields of :class:`Body`, and for a mesh its OBJ, STL or PLY file and SHA-256, see
    :func:`plab.files.pinned`.

    Raises:
        SceneError: If a mesh has no file, or another shape has one.
        plab.files.ShapeError: If the file cannot be used.
    """
    if shape != "mesh":
        if file is not None:
            raise SceneError(f"file has no effect with shape {shape}: omit it, or use shape mesh")
        return Body(shape, vector3(center), tuple(size), particles, **material)
    if file is None:
        raise SceneError("shape mesh needs a file: name an OBJ, STL or PLY file")
    return Body(shape, vector3(center), tuple(size), particles, mesh=load_mesh(file, sha256), **material)


# ------------------------------------------------------------------------------------------- manipulators

ROLL_RADIUS = 0.03
"""Distance travelled by a rolling pin per radian of roll, independent of its radius, as in the PlasticineLab
release."""


@dataclass(frozen=True)
class ManipulatorShape:
    """Properties of all manipulators of one shape.

    Attributes:
        size_names: Names of the entries of :attr:`Manipulator.size`, in order; all lengths [domain units].
        motion: Motion rule of :func:`plab.sim.motion.advance_pose`: ``translate``, ``roll``, ``grip``,
            ``rigid`` (translation and world rotation), ``twist`` (the same, neither scaled nor clipped nor
            bounded) or ``static``.
        action_names: Name of each action component, in order. Each is clipped to [-1, 1]. ``x``, ``y``,
            ``z``, ``vertical`` and ``close`` (of the gap) are lengths, all others angles.
        outline: Shape with the same surface; default: this shape.
        support: Distance from the position to the farthest point along directions, as a function of the
            sizes and unit vectors in the manipulator's frame, shape [3] or [3, number]; None for shapes that
            grip between their parts.
    """

    size_names: tuple[str, ...]
    motion: str
    action_names: tuple[str, ...]
    outline: str = ""
    support: Callable[[Sequence[float], np.ndarray], Any] | None = None

    @property
    def moves(self) -> bool:
        """True if actions move the manipulator."""
        return bool(self.action_names)

    @property
    def turns(self) -> bool:
        """True if the rotation depends on the actions."""
        return any(name not in (*_LENGTHS, "close") for name in self.action_names)

    @property
    def scaled(self) -> bool:
        """True if actions are multiples of :attr:`Manipulator.scale`, clipped to [-1, 1]."""
        return self.motion != "twist"

    @property
    def grips(self) -> bool:
        """True if the gap depends on the actions."""
        return "close" in self.action_names


_XYZ = ("x", "y", "z")
_LENGTHS = (*_XYZ, "vertical")
_ROTATION = ("rotation_x", "rotation_y", "rotation_z")


def _capsule_support(size: Sequence[float], d: np.ndarray) -> Any:
    return 0.5 * size[0] * abs(d[1]) + size[1]


MANIPULATOR_SHAPES: dict[str, ManipulatorShape] = {
    "Sphere": ManipulatorShape(("radius",), "translate", _XYZ, support=lambda size, _d: size[0]),
    "Capsule": ManipulatorShape(("h", "r"), "translate", _XYZ, support=_capsule_support),
    "RollingPin": ManipulatorShape(
        ("h", "r"), "roll", ("roll", "yaw", "vertical"), "Capsule", _capsule_support
    ),
    "Chopsticks": ManipulatorShape(("h", "r"), "grip", (*_XYZ, *_ROTATION, "close")),
    "Torus": ManipulatorShape(
        ("tx", "ty"), "translate", _XYZ, support=lambda size, d: size[0] * np.hypot(d[0], d[2]) + size[1]
    ),
    "Cylinder": ManipulatorShape(
        ("radius", "half_height"),
        "static",
        (),
        support=lambda size, d: size[0] * np.hypot(d[0], d[2]) + size[1] * abs(d[1]),
    ),
    "Box": ManipulatorShape(
        ("half_x", "half_y", "half_z"),
        "rigid",
        (*_XYZ, *_ROTATION),
        support=lambda size, d: np.abs(d).T @ np.asarray(size),
    ),
}
"""The manipulators of the suite: Sphere, Capsule (axis y), RollingPin (a capsule that rolls), Chopsticks
(two parallel capsules along own -y), Torus (axis y; major radius tx, minor radius ty), Cylinder (axis y),
Box; and links of articulated models, ``<outline>Link``, which follow a twist per environment step: their
displacement [domain units] and the rotation vector of their turn about the world's axes [rad]."""

MANIPULATOR_SHAPES |= {
    f"{name}Link": replace(
        MANIPULATOR_SHAPES[name], motion="twist", action_names=(*_XYZ, *_ROTATION), outline=name
    )
    for name in ("Capsule", "Box", "Sphere", "Cylinder")
}

MANIPULATORS_MAX = 31
"""Maximum number of manipulators in a scene, limited by a bit mask of manipulators near a node."""


@dataclass(frozen=True)
class Manipulator:
    """One rigid, kinematic manipulator.

    Attributes are those of :class:`plab.config.ManipulatorConfig`. Lengths in ``size`` are named by
    ``MANIPULATOR_SHAPES[shape].size_names``. Bounds of the position are applied after every substep. Only
    chopsticks use ``gap`` and ``minimal_gap``.
    """

    shape: str
    size: tuple[float, ...]
    position: Vec3
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    scale: tuple[float, ...] = ()
    friction: float = 0.9
    lower_bound: Vec3 = (0.0, 0.0, 0.0)
    upper_bound: Vec3 = (1.0, 1.0, 1.0)
    gap: float = 0.06
    minimal_gap: float = 0.06

    @property
    def kind(self) -> ManipulatorShape:
        """Properties of the shape."""
        return MANIPULATOR_SHAPES[self.shape]

    @property
    def outline(self) -> str:
        """Shape with the same surface."""
        return self.kind.outline or self.shape

    @property
    def action_dim(self) -> int:
        """Number of action components, 0 for a static manipulator."""
        return len(self.kind.action_names)

    @property
    def extent(self) -> float:
        """Upper bound of the distance of its points from its position [domain units]; infinite for shapes
        that grip between their parts."""
        if self.kind.support is None:
            return math.inf
        along = [float(self.kind.support(self.size, sign * axis)) for axis in np.eye(3) for sign in (1, -1)]
        return float(np.linalg.norm([max(along[:2]), max(along[2:4]), max(along[4:])]))

    def largest_step(self) -> float:
        """Upper bound of the displacement of any point of the manipulator in an environment step [domain
        units]; 0 for links, whose motion is bounded by their model."""
        if not self.kind.scaled:
            return 0.0
        # Separate bounds for the roll, during which the axis moves, too, and for half of the gap.
        scale = dict(zip(self.kind.action_names, np.abs(self.scale).tolist(), strict=True))
        out = scale.pop("roll", 0.0) * (ROLL_RADIUS + self.size[-1]) + 0.5 * scale.pop("close", 0.0)
        lengths = [scale.pop(name) for name in _LENGTHS if name in scale]
        angle = float(np.linalg.norm([*scale.values()]))
        return out + float(np.linalg.norm(lengths)) + angle * (sum(self.size) + self.gap)


@dataclass(frozen=True)
class Scene:
    """Scene of one environment, the input of the simulator.

    Attributes:
        name: Task name, for messages.
        bodies: Bodies of plasticine.
        manipulators: Manipulators, in the order in which they act on the grid and in the action vector.
        youngs_modulus: Default Young's modulus E of bodies.
        poisson_ratio: Default Poisson ratio nu.
        yield_stress: Default von Mises yield stress; ``inf`` for purely elastic bodies.
        floor_friction: Floor friction: 0 slips, 10 or more sticks, Coulomb friction in between.
        gravity: Acceleration added to every grid node; the suite's is (0, -30, 0).
        grid_size: Grid nodes per axis; node i is at i / grid_size.
        dt: Time step of one substep.
        substeps: Substeps per environment step.
        horizon: Environment steps per episode.
        particle_seed: Seed of the particles' positions.
        sampling_convention: Random generator for these positions, one of :data:`CONVENTIONS`.
        digits_convention: Treatment of quaternions that are not exactly of unit length, one of
            :data:`CONVENTIONS`: ``plab`` normalises them, ``release`` only after the first motion.
        floor_stencil: Stencil of particles within half a cell of a lower face, one of :data:`CONVENTIONS`:
            plab's includes the layer of nodes below the domain, the release's begins at node 0, with weights
            from -0.25 to 1.125.
        kinematics: Articulated model whose links are the last manipulators; None without one.
    """

    name: str
    bodies: tuple[Body, ...]
    manipulators: tuple[Manipulator, ...]
    youngs_modulus: float = 5000.0
    poisson_ratio: float = 0.2
    yield_stress: float = 50.0
    floor_friction: float = 1.5
    gravity: Vec3 = (0.0, -30.0, 0.0)
    grid_size: int = 64
    dt: float = 1e-4
    substeps: int = 19
    horizon: int = 50
    particle_seed: int = 0
    sampling_convention: str = "plab"
    digits_convention: str = "plab"
    floor_stencil: str = "plab"
    kinematics: Chain | None = None

    @property
    def dx(self) -> float:
        """Grid spacing."""
        return 1.0 / self.grid_size

    @property
    def particle_volume(self) -> float:
        """Volume per particle, (dx/2)^2: squared in three dimensions as well, as in the PlasticineLab
        release. It cancels in the equations of motion, and only scales the mass tensor and thus the loss."""
        return (0.5 * self.dx) ** 2

    @property
    def particle_mass(self) -> float:
        """Mass per particle; the density is 1."""
        return self.particle_volume

    @property
    def material(self) -> Material:
        """Default material of bodies."""
        return Material(self.youngs_modulus, self.poisson_ratio, self.yield_stress)

    @property
    def materials(self) -> tuple[Material, ...]:
        """Materials of the bodies, in order."""
        return tuple(replace(self.material, **body.own_material) for body in self.bodies)

    @property
    def material_count(self) -> int:
        """Number of materials in the simulator: one per body if any body has its own, otherwise 1."""
        return len(self.bodies) if any(body.own_material for body in self.bodies) else 1

    @property
    def laws(self) -> tuple[str, ...]:
        """Names of the laws of the materials: one, or one per body if any body has its own material."""
        return tuple(material.law for material in self.materials[: self.material_count])

    @property
    def particle_bodies(self) -> np.ndarray:
        """Index of each particle's body, shape [particle]."""
        return np.repeat(np.arange(len(self.bodies)), [body.particles for body in self.bodies])

    @property
    def action_dim(self) -> int:
        """Length of the action vector, see :attr:`action_names`."""
        return len(self.action_names)

    @property
    def tools(self) -> tuple[Manipulator, ...]:
        """Manipulators with separate action components: all except the links of an articulated model."""
        links = len(self.kinematics.links) if self.kinematics else 0
        return self.manipulators[: len(self.manipulators) - links]

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the components of the action vector: those of the tools in order, then those of the
        articulated model."""
        own = [f"{k}_{name}" for k, tool in enumerate(self.tools) for name in tool.kind.action_names]
        return (*own, *(self.kinematics.components if self.kinematics else ()))

    @property
    def particle_count(self) -> int:
        """Number of particles in all bodies."""
        return sum(b.particles for b in self.bodies)

    @property
    def stable_dt(self) -> float:
        """Largest admissible time step [s], limited by the stiffest body; see
        :meth:`plab.laws.Law.largest_step`."""
        return self._stiffest.largest_step(self.dx)

    @property
    def _stiffest(self) -> Material:
        """Material of the body that limits the time step."""
        return min(self.materials, key=lambda m: m.largest_step(self.dx))

    def facts(self) -> dict[str, Any]:
        """Return the scene as plain data, without meshes and inherited values of bodies."""
        facts = asdict(self)
        if self.kinematics is None:
            del facts["kinematics"]
        for body in facts["bodies"]:
            for key in (*MATERIAL_KEYS, "law", "parameters", "mesh"):
                if body[key] in (None, (), ""):
                    del body[key]
        return facts

    def validate(self) -> None:
        """Raise SceneError for an invalid scene; the message names the field and a valid value."""
        for parts in (self.bodies, self.manipulators):
            _require(isinstance(parts, Sequence), "bodies and manipulators must be tuples: (body,)")
        _require(len(self.bodies) > 0, "a scene needs at least one body")
        for name, least in (("grid_size", 8), ("substeps", 1)):
            count = getattr(self, name)
            _require(is_whole(count, least), f"{name} must be a whole number, {least} or more, not {count}")
        self.material.validate()
        for number, material in enumerate(self.materials):
            material.validate(f"bodies[{number}]: ")
        _require(self.dt > 0, f"dt must be positive (got {self.dt:g})")
        _require(self.floor_friction >= 0, f"floor_friction must be at least 0 (got {self.floor_friction:g})")
        if self.dt > self.stable_dt:
            steps = math.ceil(self.substeps * self.dt / self.stable_dt)
            one = self.material_count == 1
            what = "material" if one else f"bodies[{self.materials.index(self._stiffest)}]"
            raise SceneError(
                f"dt {self.dt:g} is above the stability limit {self.stable_dt:.3g} of {what} and grid: "
                f"use dt <= {self.substeps * self.dt / steps:.3g} with substeps >= {steps}"
            )
        for name in ("sampling_convention", "digits_convention", "floor_stencil"):
            choice = getattr(self, name)
            _require(choice in CONVENTIONS, f"{name} '{choice}' is not one of {', '.join(CONVENTIONS)}")
        _require(np.shape(self.gravity) == (3,), f"gravity must be three numbers, not {self.gravity}")
        limit = self.dx / self.dt**2
        advice = f"accelerates by more than a cell per substep: use at most {limit:.3g}"
        _require(math.hypot(*self.gravity) <= limit, f"gravity {self.gravity} {advice}")
        for number, body in enumerate(self.bodies):
            self._validate_body(f"bodies[{number}]", body)
        count = len(self.manipulators)
        _require(
            count <= MANIPULATORS_MAX,
            f"{count} manipulators are more than {MANIPULATORS_MAX}: leave some out, "
            "or links of the articulated model by kinematics.omit",
        )
        if self.kinematics is not None:
            self._require_slow("kinematics", self.kinematics.largest_step())
        for number, manipulator in enumerate(self.manipulators):
            self._validate_manipulator(f"manipulators[{number}]", manipulator)

    def _validate_body(self, label: str, body: Body) -> None:
        shapes = ", ".join(BODY_SHAPES)
        _require(body.shape in BODY_SHAPES, f"{label}: shape '{body.shape}' is not one of {shapes}")
        entries = 3 if body.shape == "box" else 1
        fits = np.shape(body.size) == (entries,) and all(0 < size < math.inf for size in body.size)
        _require(fits, f"{label}: a {body.shape} needs {entries} positive size(s), not {body.size}")
        _require(
            is_whole(body.particles),
            f"{label}: particles must be a positive whole number, not {body.particles}",
        )
        _require(np.shape(body.center) == (3,), f"{label}: center must be three numbers, not {body.center}")
        top = 1.0 - 3.0 * self.dx
        for name, middle, half in zip("xyz", body.center, body.half_extent(), strict=True):
            low, high = middle - half, middle + half
            # Bodies may rest on the floor at y = 0 exactly, so rounding errors below it are tolerated.
            _require(
                low >= -1e-9 and high <= top + 1e-9,
                f"{label}: reaches {name} = {low:.3g} .. {high:.3g}, outside the domain 0 .. {top:.4g}: "
                f"put its centre's {name} into {half:.3g} .. {top - half:.3g}",
            )
        if body.mesh is not None:
            thickness = body.size[0] * body.mesh.thickness
            least = 1.01 * body.size[0] * self.dx / thickness
            _require(
                thickness >= self.dx,
                f"{label}: its hydraulic diameter {thickness:.2g} is less than a cell of the grid, "
                f"{self.dx:.2g}: use a size of {least:.2g} or more, or a finer grid",
            )

    def _validate_manipulator(self, label: str, tool: Manipulator) -> None:
        shape, shapes = MANIPULATOR_SHAPES.get(tool.shape), ", ".join(MANIPULATOR_SHAPES)
        if shape is None:
            raise SceneError(f"{label}: shape '{tool.shape}' is not one of {shapes}")
        label = f"{label}: a {tool.shape}"
        sized = np.shape(tool.size) == (len(shape.size_names),)
        fits = sized and all(0 < size < math.inf for size in tool.size)
        names = ", ".join(shape.size_names)
        _require(fits, f"{label} needs positive, finite sizes ({names}), not {tool.size}")
        scales = tool.action_dim if shape.scaled else 0
        _require(np.shape(tool.scale) == (scales,), f"{label} needs {scales} scale(s), not {tool.scale}")
        norm = math.hypot(*tool.rotation)
        _require(abs(norm - 1.0) < 1e-3, f"{label} needs a unit quaternion: rotation has length {norm:.4g}")
        friction = f"{label} has friction {tool.friction:g}: it must be finite and at least 0"
        _require(0 <= tool.friction < math.inf, friction)
        for name in ("position", "scale", "gap"):
            values = getattr(tool, name)
            _require(bool(np.isfinite(values).all()), f"{label} needs a finite {name}, not {values}")
        low, high = tool.lower_bound, tool.upper_bound
        ranges = zip(low, tool.position, high, strict=True)
        inside = all(a <= x <= b for a, x, b in ranges) or not shape.scaled
        _require(inside, f"{label} has position {tool.position} outside its bounds {low} .. {high}")
        _require(tool.gap >= tool.minimal_gap, f"{label} has gap {tool.gap:g}, below its minimal_gap")
        self._require_slow(f"{label}: scale {tool.scale}", tool.largest_step())

    def _require_slow(self, label: str, way: float) -> None:
        """Raise SceneError for motions of more than one cell per substep, which nodal contact could miss."""
        limit = self.substeps * self.dx
        if way > limit:
            raise SceneError(
                f"{label} moves it by up to {way:.3g} per step, more than a cell per substep: scale it by "
                f"{limit / way:.2g} or less, or use substeps >= {math.ceil(way / self.dx)}"
            )


def is_whole(value: object, least: int = 1) -> bool:
    """Return True for a whole number of at least ``least``."""
    return isinstance(value, int | np.integer) and bool(value >= least)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise SceneError(message)


def link_manipulators(chain: Chain, friction: float) -> tuple[Manipulator, ...]:
    """Return the links of an articulated model as manipulators with their poses at t = 0."""
    frames = chain.frames([joint.start for joint in chain.joints])
    turns = scipy.spatial.transform.Rotation.from_matrix(frames[:, :3, :3]).as_quat(scalar_first=True)
    wide: dict[str, Any] = {"lower_bound": (-1.0,) * 3, "upper_bound": (2.0,) * 3}
    return tuple(
        Manipulator(k.shape, k.size, vector3(at.tolist()), tuple(q.tolist()), friction=friction, **wide)
        for k, at, q in zip(chain.links, frames[:, :3, 3], turns, strict=True)
    )


def sample_particles(scene: Scene) -> np.ndarray:
    """Sample the initial particle positions [domain units], uniformly inside each body; shape [particle, 3],
    float64, in the order of the bodies. They depend only on ``particle_seed``, ``sampling_convention`` and
    the bodies."""
    # With seed 0 bitwise identical to the release's.
    release = scene.sampling_convention == "release"
    rng = (np.random.RandomState if release else np.random.default_rng)(scene.particle_seed)
    parts = []
    for body in scene.bodies:
        if body.mesh is not None:
            offset = body.size[0] * body.mesh.fill(body.particles, rng.random)
        elif body.shape == "box":
            offset = (rng.random((body.particles, 3)) - 0.5) * np.asarray(body.size)
        else:
            direction = rng.normal(size=(body.particles, 3))
            length = np.linalg.norm(direction, axis=1, keepdims=True)
            share = rng.random((body.particles, 1))
            if release:
                offset = body.size[0] * share ** (1 / 3) * direction / length
            else:
                offset = body.size[0] * np.cbrt(share) * (direction / length)
        parts.append(np.asarray(body.center) + offset)
    return np.concatenate(parts)


# ----------------------------------------------------------------------------------------------- cameras


@dataclass(frozen=True)
class Camera:
    """A perspective camera for an environment's observations or for rendered pictures.

    Attributes:
        position: Position [domain units].
        target: Point in the middle of the picture [domain units].
        field_of_view: Vertical field of view [degrees], in (0, 180).
        size: Width and height of pictures [pixels].
        near: Near clipping depth [domain units], positive.
        far: Far clipping depth [domain units], which is also the depth of the background.
    """

    position: Vec3
    target: Vec3
    field_of_view: float = 45.0
    size: tuple[int, int] = (64, 64)
    near: float = 0.01
    far: float = 10.0

    def __post_init__(self) -> None:
        """Check the values; SceneError names an invalid attribute."""
        object.__setattr__(self, "position", vector3(self.position))
        object.__setattr__(self, "target", vector3(self.target))
        if math.dist(self.position, self.target) < 1e-9:
            raise SceneError("camera.position and camera.target must differ")
        if not 0.0 < self.field_of_view < 180.0:
            raise SceneError(f"camera.field_of_view must be in (0, 180) degrees (got {self.field_of_view:g})")
        if np.shape(self.size) != (2,) or not all(map(is_whole, self.size)):
            raise SceneError(f"camera.size must be a width and a height in pixels (got {self.size})")
        if not 0.0 < self.near < self.far:
            raise SceneError(f"camera.near must be positive and below camera.far (got {self.near:g})")

    def axes(self) -> np.ndarray:
        """Return the right, up and backward unit vectors in rows, shape [3, 3].

        A camera that looks straight down or up has -z or z at the top of its pictures.
        """
        back = np.subtract(self.position, self.target)
        back /= np.linalg.norm(back)
        up = np.array([0.0, 1.0, 0.0])
        if abs(back[1]) > 1.0 - 1e-9:
            up = np.array([0.0, 0.0, -back[1]])
        right = np.cross(up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    @property
    def focal_length(self) -> float:
        """Focal length [pixels]."""
        return self.size[1] / 2 / math.tan(math.radians(self.field_of_view) / 2)

    def intrinsics(self) -> np.ndarray:
        """Return the matrix from camera coordinates (x right, y down, z forward) to pixels, shape [3, 3]."""
        width, height = self.size
        return np.array([[self.focal_length, 0, width / 2], [0, self.focal_length, height / 2], [0, 0, 1]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points of the scene onto the image.

        Args:
            points: Positions [domain units], shape [..., 3].

        Returns:
            Column and row [pixels] from the upper left corner, shape [..., 2].
        """
        width, height = self.size
        right, up, back = np.moveaxis((points - np.array(self.position)) @ self.axes().T, -1, 0)
        scale = self.focal_length
        return np.stack([width / 2 - scale * right / back, height / 2 + scale * up / back], axis=-1)

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Convert depth [domain units], shape [..., height, width], to positions [domain units], shape [...,
        height, width, 3]."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - width / 2) / self.focal_length
        y = (height / 2 - np.arange(height) - 0.5) / self.focal_length
        rays = np.stack([*np.meshgrid(x, y), -np.ones((height, width))], axis=-1) @ self.axes()
        return np.array(self.position) + depth[..., None] * rays


def named_cameras(given: Mapping[str, Any]) -> dict[str, Camera]:
    """Return cameras by name, given cameras or their attributes; SceneError names an invalid camera."""
    cameras = {}
    for name, own in given.items():
        try:
            cameras[name] = own if isinstance(own, Camera) else Camera(**own)
        except (SceneError, TypeError, ValueError) as error:
            raise SceneError(f"cameras.{name}: {str(error).removeprefix('Camera.__init__() ')}") from None
    return cameras
