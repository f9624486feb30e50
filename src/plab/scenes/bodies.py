"""Bodies of plasticine: spheres, boxes and solids bounded by meshes; and their materials."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.errors import ConfigError, PlabError, pick
from plab.laws import Law
from plab.plugins import Registry, load_object

if TYPE_CHECKING:
    from plab.scenes.mesh import Mesh

__all__ = [
    "BODY_SHAPES",
    "LAWS",
    "MATERIAL_KEYS",
    "Body",
    "Material",
    "MeshBody",
    "SceneError",
    "Vec3",
    "find_law",
    "make_body",
    "vector3",
]

BODY_SHAPES = ("sphere", "box", "mesh")
"""Values of :attr:`Body.shape`."""

MATERIAL_KEYS = ("youngs_modulus", "poisson_ratio", "yield_stress")
"""Material parameters that bodies inherit from their scene by default, as fields of a :class:`Material`."""

LAWS: Mapping[str, Law] = Registry(
    Law,
    {
        name: f"plab.laws.{name}:{name.upper()}"
        for name in ("von_mises", "elastic", "drucker_prager", "fluid", "viscoplastic")
    },
)
"""plab's own laws by name."""

Vec3 = tuple[float, float, float]


def vector3(values: Sequence[float]) -> Vec3:
    """Return three numbers as a tuple.

    Raises:
        ValueError: If they are not three.
    """
    x, y, z = values
    return x, y, z


def find_law(name: str) -> Law:
    """Return a law by its name, or by ``module:NAME`` for a law outside plab.

    Raises:
        plab.config.ConfigError: If it does not exist.
    """
    if name in LAWS:
        return LAWS[name]
    if ":" not in name:
        raise ConfigError(f"law '{name}' does not exist; {pick(name, list(LAWS))}; or module:NAME")
    return load_object(name, Law)


class SceneError(PlabError, ValueError):
    """A scene cannot be simulated; the message has the reason and a valid value."""


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
        """The law."""
        return find_law(self.law)

    @property
    def values(self) -> dict[str, float]:
        """The law's parameters, in its order."""
        given = {key: getattr(self, key) for key in MATERIAL_KEYS} | dict(self.parameters)
        return {key: given.get(key, default) for key, default in self.kind.defaults.items()}

    @property
    def shear_modulus(self) -> float:
        """Lame parameter mu."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> float:
        """Lame parameter lambda."""
        nu = self.poisson_ratio
        return self.youngs_modulus * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))

    def largest_step(self, dx: float) -> float:
        """Return the largest stable time step [s] on a grid of spacing dx."""
        return self.kind.largest_step(self.values, dx)

    def validate(self, label: str = "") -> None:
        """Raise SceneError, with a message that begins with ``label``, if a value is out of range."""
        for name in dict(self.parameters):
            if name not in self.kind.keys:
                raise SceneError(
                    f"{label}{name} is no parameter of law {self.law}: {', '.join(self.kind.keys)}"
                )
        for parameter in self.kind.parameters:
            value = self.values[parameter.name]
            if not parameter.admits(value):
                raise SceneError(f"{label}{parameter.name} {value:g} is outside {parameter.interval}")


@dataclass(frozen=True)
class Body:
    """One body of plasticine, initially filled with particles.

    Attributes:
        shape: ``sphere`` or ``box``; that of a :class:`MeshBody` is ``mesh``.
        center: Centre [domain units].
        size: Sphere: ``(radius,)``. Box: full edge lengths ``(x, y, z)``.
        particles: Number of particles drawn uniformly inside.
        youngs_modulus: Young's modulus E; the scene's if None.
        poisson_ratio: Poisson ratio nu; the scene's if None.
        yield_stress: von Mises yield stress; the scene's if None.
        law: Name of its law, see :func:`find_law`; ``von_mises`` if None.
        parameters: Other parameters of the law, by name.
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

    def __post_init__(self) -> None:
        """Make the parameters hashable."""
        object.__setattr__(self, "parameters", tuple(sorted(dict(self.parameters).items())))

    @property
    def own_material(self) -> dict[str, Any]:
        """Fields of its :class:`Material` that differ from the scene's."""
        values = {key: getattr(self, key) for key in (*MATERIAL_KEYS, "law")}
        own = {key: value for key, value in values.items() if value is not None}
        return {**own, "parameters": self.parameters} if self.parameters else own

    def half_extent(self) -> np.ndarray:
        """Half of the bounding box's edges, shape [3]."""
        return np.full(3, self.size[0]) if self.shape == "sphere" else np.asarray(self.size, dtype=float) / 2

    @property
    def volume(self) -> float:
        """Volume at t = 0 [domain units^3]."""
        return 4 / 3 * math.pi * math.prod(self.size * 3) if self.shape == "sphere" else math.prod(self.size)


@dataclass(frozen=True)
class MeshBody(Body):
    """A body in the shape of a mesh.

    Attributes:
        mesh: The mesh; ``center`` is the centre of its bounding box, ``size`` is ``(longest,)``, the longest
            edge of that box.
    """

    mesh: Mesh

    def half_extent(self) -> np.ndarray:
        """See :meth:`Body.half_extent`."""
        return self.size[0] / 2 * self.mesh.extent

    @property
    def volume(self) -> float:
        """See :attr:`Body.volume`."""
        return math.prod(self.size * 3) * self.mesh.volume


def make_body(
    shape: str,
    center: Sequence[float],
    size: Sequence[float],
    particles: int,
    file: str | None = None,
    sha256: str | None = None,
    **material: Any,
) -> Body:
    """Create a body from a configuration, reading the mesh file if any.

    Args:
        shape: ``sphere``, ``box`` or ``mesh``.
        center: Centre (x, y, z) [domain units].
        size: Sphere: radius. Box: edge lengths x, y, z. Mesh: longest edge of its bounding box [domain
            units].
        particles: Number of particles.
        file: Mesh only: OBJ, STL or PLY file, see :func:`plab.files.pinned`.
        sha256: SHA-256 of the file, likewise.
        **material: Its own law and parameters, as fields of the body.

    Raises:
        SceneError: If a mesh has no file, or another shape has one.
        plab.files.ShapeError: If the file cannot be used.
    """
    if shape != "mesh":
        if file is not None:
            raise SceneError(f"file has no effect with shape {shape}: leave it out, or use shape mesh")
        return Body(shape, vector3(center), tuple(size), particles, **material)
    if file is None:
        raise SceneError("shape mesh needs a file: name an OBJ, STL or PLY file")
    # Imported here, because few scenes have meshes.
    from plab.scenes.mesh import load_mesh

    return MeshBody(shape, vector3(center), tuple(size), particles, load_mesh(file, sha256), **material)
