"""Types of the ``task`` section: bodies, manipulators, material, target and variants."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from plab.config import ranges
from plab.errors import ConfigError, located
from plab.files import pinned
from plab.scenes import (
    MATERIAL_KEYS,
    Body,
    Manipulator,
    find_law,
    link_manipulators,
    make_body,
    named_cameras,
)
from plab.targets import TargetError, make_recipe

if TYPE_CHECKING:
    from plab.kinematics import Chain


@dataclass
class BodyConfig(ranges.Section):
    """A plasticine body.

    Attributes:
        shape: ``sphere``, ``box`` or ``mesh``.
        center: Centre (x, y, z) [domain units]; for a mesh, of its bounding box.
        size: Sphere: ``[radius]``. Box: edge lengths ``[x, y, z]``. Mesh: ``[longest]``, the longest edge of
            its bounding box; it keeps its proportions.
        particles: Number of particles before ``sim.particles_scale``.
        file: Mesh only: OBJ, STL or PLY file, y up. A relative path is searched for in the working directory,
            in the config folder and in its parent folder.
        sha256: Mesh only: SHA-256 of the file. Default: computed; another checksum is rejected.
        youngs_modulus: Young's modulus E; default: the task's, as for the following keys.
        poisson_ratio: Poisson ratio nu.
        yield_stress: Norm of the stress deviator at yield; ``inf`` never yields.
        law: Constitutive law: a key of :data:`plab.scenes.LAWS`, or the ``module:NAME`` of a custom law;
            default: ``von_mises``.
        parameters: Other parameters of the law, by name; default: the law's.
    """

    shape: str
    center: list[float] = field(metadata=ranges.POINT)
    size: list[float]
    particles: int = field(metadata=ranges.COUNT)
    file: str | None = None
    sha256: str | None = None
    youngs_modulus: float | None = field(default=None, metadata=ranges.POSITIVE)
    poisson_ratio: float | None = None
    yield_stress: float | None = field(default=None, metadata=ranges.NOT_NEGATIVE)
    law: str | None = None
    parameters: dict[str, float] = field(default_factory=dict)

    def build(self, particles_scale: float = 1.0) -> Body:
        """Return the scene's body, with its number of particles scaled (at least one); errors are those of
        :func:`plab.scenes.make_body`."""
        particles = max(1, round(self.particles * particles_scale))
        material = {key: getattr(self, key) for key in (*MATERIAL_KEYS, "law", "parameters")}
        return make_body(self.shape, self.center, self.size, particles, self.file, self.sha256, **material)


@dataclass
class ManipulatorConfig(ranges.Section):
    """A rigid manipulator.

    Attributes:
        shape: A key of :data:`plab.scenes.MANIPULATOR_SHAPES`.
        size: Lengths of the shape [domain units].
        position: Position (x, y, z) at the start [domain units].
        rotation: Unit quaternion (w, x, y, z) at the start.
        scale: Motion per environment step at action 1, one per action component [domain units or radians].
        friction: Coulomb friction with the plasticine.
        lower_bound: Lowest position (x, y, z) [domain units].
        upper_bound: Highest position (x, y, z) [domain units].
        gap: Chopsticks only: distance between the two axes at the start [domain units].
        minimal_gap: Chopsticks only: smallest gap [domain units].
    """

    shape: str
    size: list[float]
    position: list[float] = field(metadata=ranges.POINT)
    rotation: list[float] = field(metadata=ranges.ROTATION)
    scale: list[float]
    friction: float
    lower_bound: list[float] = field(metadata=ranges.POINT)
    upper_bound: list[float] = field(metadata=ranges.POINT)
    gap: float | None = field(default=None, metadata=ranges.POSITIVE)
    minimal_gap: float | None = field(default=None, metadata=ranges.POSITIVE)

    def build(self) -> Manipulator:
        """Return the scene's manipulator."""
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in vars(self).items()
            if value is not None
        }
        return Manipulator(**values)


@dataclass
class KinematicsConfig(ranges.Section):
    """An articulated model: links that move by joint-space actions. Patterns are regular expressions that
    must match whole names; the last match applies.

    Attributes:
        model: MJCF or URDF file, or ``package:path`` of a file in an installed package.
        root: Body whose frame is placed in the domain; default: the model's world frame.
        size: Domain units per unit of length of the model.
        position: Position (x, y, z) of the origin of that frame [domain units].
        rotation: Unit quaternion (w, x, y, z) from that frame's axes to the domain's; default: z up becomes y
            up.
        free: Whether the base moves, by the joints ``base_x``, ``base_y``, ``base_z``, ``base_yaw``,
            ``base_pitch`` and ``base_roll``.
        scale: Motion per environment step at action 1, by patterns of joints [rad or domain units]; joints
            without a scale are fixed.
        start: Initial positions, by patterns of joints; default: 0, or the nearest limit.
        limits: Lowest and highest positions, by patterns of joints; default: the model's.
        together: Patterns of joints that share one action component, by the component's name.
        omit: Patterns of omitted collision geometry.
        friction: Coulomb friction of all links with the plasticine.
        sha256: SHA-256 of the tree. Default: computed; another checksum is rejected.
    """

    model: str
    scale: dict[str, float] = field(metadata=ranges.UNIT)
    root: str | None = None
    size: float = field(default=1.0, metadata=ranges.POSITIVE)
    position: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.5], metadata=ranges.POINT)
    rotation: list[float] = field(
        default_factory=lambda: [0.5**0.5, -(0.5**0.5), 0.0, 0.0], metadata=ranges.ROTATION
    )
    free: bool = False
    start: dict[str, float] = field(default_factory=dict)
    limits: dict[str, list[Any]] = field(default_factory=dict, metadata=ranges.within(ranges.vector, 2))
    together: dict[str, str] = field(default_factory=dict)
    omit: list[str] = field(default_factory=list)
    friction: float = field(default=5.0, metadata=ranges.NOT_NEGATIVE)
    sha256: str | None = None

    def build(self) -> Chain:
        """Return the scene's articulated model, replace the model's name by its path, unless it is in a
        package, and add its SHA-256; raise ConfigError if the model cannot be read or has changed, or a
        pattern matches nothing."""
        # Imported here, because few tasks have an articulated model.
        from plab.kinematics import ModelError, locate_model, read_model

        patterns = {key: getattr(self, key) for key in ("scale", "start", "limits", "together")}
        with located("task.kinematics"):
            self.model = locate_model(self.model, by_name=self.sha256 is not None)
            chain, digest = read_model(self.model, self.root, self.size, self.omit)
            if self.sha256 not in (None, digest):
                raise ModelError(
                    f"{self.model} differs from the model of this configuration: its SHA-256 begins with "
                    f"{digest[:8]}, not with {str(self.sha256)[:8]!r}"
                )
            self.sha256 = digest
            return chain.placed(self.position, self.rotation, self.free, **patterns)


@dataclass
class RangeConfig(ranges.Section):
    """Numbers sampled uniformly and independently, each between two bounds.

    Attributes:
        low: Lower bounds.
        high: Upper bounds, equal in number.
    """

    low: list[float]
    high: list[float]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for empty ranges."""
        ranges.vector(f"{path}.low", self.low, len(self.low))
        ranges.vector(f"{path}.high", self.high, len(self.low))
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ConfigError(f"{path}: low {self.low} is above high {self.high}")


@dataclass
class DrawConfig(RangeConfig):
    """A sampled list of numbers, and the keys that receive it.

    Attributes:
        keys: Dotted keys of the task that receive the sampled list, such as ``manipulators.pillar.position``.
    """

    keys: list[str]


@dataclass
class RandomConfig(ranges.Section):
    """Ranges of ``variant=random``.

    Attributes:
        variant: Variant with the values that are not sampled; default: the task itself.
        shift: Common displacement (x, y, z) of all bodies and moving manipulators, except those with their
            own range [domain units]; default: none.
        reach: Largest distance along an axis between a body and the target's body of the same name; samples
            beyond it are rejected [domain units]. None sets no limit.
        ranges: Additional sampled lists, by name.
    """

    variant: str | None = None
    shift: RangeConfig | None = None
    reach: float | None = field(default=None, metadata=ranges.POSITIVE)
    ranges: dict[str, DrawConfig] | None = None

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        if self.shift is not None:
            ranges.vector(f"{path}.shift.low", self.shift.low, 3)


@dataclass
class TaskConfig(ranges.Section):
    """Scene and target shape of a task.

    Attributes:
        name: Name of the task in results and reports.
        youngs_modulus: Young's modulus E; the density is 1.
        poisson_ratio: Poisson ratio nu.
        yield_stress: Norm of the stress deviator at yield; ``inf`` never yields.
        floor_friction: Friction of the floor: 0 slips, 10 or more sticks.
        gravity: Acceleration (x, y, z).
        bodies: Plasticine bodies, by name.
        manipulators: Manipulators, by name, in the order of the action vector.
        kinematics: An articulated model, whose links and actions follow those of the manipulators; or None.
        target: ``recipe`` and the fields of that recipe in :data:`plab.targets.RECIPES`.
        variants: Overrides of the task by variant, in the structure of the task.
        random: Ranges of ``variant=random``: the fields of :class:`RandomConfig`. Empty in a run's
            configuration.
        randomize: Ranges of parameters sampled in every episode, see :mod:`plab.config.randomization`;
            default: no randomisation.
        cameras: Cameras of observations by name, each with the attributes of :class:`plab.scenes.Camera`.
        stages: Targets, like ``target``, that environments present in sequence before ``target``; runs use
            only ``target``.
        release: Overrides with the numbers of the PlasticineLab release, including variants, for
            ``protocol.numbers=release``. Empty in a run's configuration.
    """

    name: str = field(metadata=ranges.NAME)
    youngs_modulus: float = field(metadata=ranges.POSITIVE)
    poisson_ratio: float
    yield_stress: float = field(metadata=ranges.NOT_NEGATIVE)
    floor_friction: float = field(metadata=ranges.NOT_NEGATIVE)
    gravity: list[float] = field(metadata=ranges.POINT)
    bodies: dict[str, BodyConfig]
    manipulators: dict[str, ManipulatorConfig]
    target: dict[str, Any]
    variants: dict[str, Any]
    random: dict[str, Any] = field(default_factory=dict)
    randomize: dict[str, Any] = field(default_factory=dict)
    cameras: dict[str, Any] = field(default_factory=dict)
    stages: list[dict[str, Any]] = field(default_factory=list)
    release: dict[str, Any] = field(default_factory=dict)
    kinematics: KinematicsConfig | None = None

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for errors that :meth:`plab.scenes.Scene.validate` does not check."""
        super().check(path)
        for variant in self.variants:
            ranges.folder_name(f"{path}.variants", variant)
        for place, target in [("", self.target), *((f"stages: {k}: ", t) for k, t in enumerate(self.stages))]:
            try:
                make_recipe(target)
            except TargetError as error:
                raise ConfigError(f"{path}.{place}{error}") from None
        if self.randomize:
            from plab.config.randomization import ranges_of

            ranges_of(self)
        with located(path):
            named_cameras(self.cameras)

    def build_bodies(self, particles_scale: float = 1.0) -> tuple[Body, ...]:
        """Return the scene's bodies, see :meth:`BodyConfig.build`; ConfigError names an invalid key."""
        bodies = []
        for name, body in self.bodies.items():
            with located(f"task.bodies.{name}"):
                bodies.append(body.build(particles_scale))
                find_law(bodies[-1].law or "von_mises")
        return tuple(bodies)

    def build_tools(self) -> dict[str, Any]:
        """Return the scene's ``manipulators`` and ``kinematics``; see :meth:`KinematicsConfig.build`."""
        tools = tuple(manipulator.build() for manipulator in self.manipulators.values())
        chain = self.kinematics.build() if self.kinematics else None
        links = link_manipulators(chain, self.kinematics.friction) if chain and self.kinematics else ()
        return {"manipulators": tools + links, "kinematics": chain}

    def pin_files(self) -> None:
        """Replace the name of each file by its path, and add the SHA-256 of its content; ConfigError names
        the key of a file that is missing, unreadable or of another kind."""
        if self.kinematics is not None:
            self.kinematics.build()
        # The file of a variant has its own hash, independent of the task's.
        bodies = {name: vars(body) for name, body in self.bodies.items()}
        _pin({"bodies": bodies, "target": self.target, "variants": self.variants}, "task")


def _pin(node: Any, path: str) -> None:
    if not isinstance(node, dict):
        return
    for key, value in node.items():
        _pin(value, f"{path}.{key}")
    if isinstance(node.get("file"), str):
        with located(path):
            node["file"], node["sha256"] = pinned(node["file"], node.get("sha256"))
