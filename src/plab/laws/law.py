"""Constitutive laws: parameters, stress, and limit of the time step."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from plab.laws.tracing import Trace, derivatives, evaluated


@dataclass(frozen=True)
class Parameter:
    """A parameter of a law.

    Attributes:
        name: Key in a task's YAML.
        default: Default value.
        interval: Admissible values, such as ``(0, inf)`` or ``[0, 0.5)``.
        unit: Unit; empty if dimensionless.
        meaning: Short description.
    """

    name: str
    default: float
    interval: str
    unit: str = ""
    meaning: str = ""

    def admits(self, value: float) -> bool:
        """Return True if a value is in the interval."""
        low, high = (float(end) for end in self.interval[1:-1].split(","))
        above = value >= low if self.interval[0] == "[" else value > low
        return above and (value <= high if self.interval[-1] == "]" else value < high)


@dataclass(frozen=True)
class Law:
    """A constitutive law of isotropic bodies of density 1.

    Its functions are plain Python on numbers, NumPy arrays, or the tracers that generate the simulator's code
    and record it for the adjoint. They may use ``+ - * /``, comparisons by ``<`` and ``>``, and NumPy's
    ``sqrt, exp, log, minimum, maximum, where``. Full matrices have 9 components in row-major order, symmetric
    ones 6: (00, 11, 22, 01, 02, 12).

    Attributes:
        name: Name in a task's YAML.
        parameters: Parameters, in the order used by functions and gradients.
        update: Function of C (9), F (9), the time step and the coefficients that returns the Kirchhoff stress
            (6) and F after the substep (9).
        stiffness: Function of the coefficients that returns 3 lambda + 2 mu at rest [pressure].
        coefficients: Function that converts the parameters to coefficients of ``update``; default: identity.
        viscosity: Function of the coefficients that returns the largest dynamic viscosity [pressure x s].
    """

    name: str
    parameters: tuple[Parameter, ...]
    update: Callable[..., tuple[Sequence[Any], Sequence[Any]]]
    stiffness: Callable[..., float]
    coefficients: Callable[..., Sequence[Any]] = lambda *values: values
    viscosity: Callable[..., float] = lambda *_: 0.0

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def defaults(self) -> dict[str, float]:
        """Default values of the parameters."""
        return {parameter.name: parameter.default for parameter in self.parameters}

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.coefficients_of(self.defaults))

    def coefficients_of(self, values: Mapping[str, float]) -> list[float]:
        """Return the coefficients for parameter values."""
        return [float(number) for number in self.coefficients(*(values[key] for key in self.keys))]

    def largest_step(self, values: Mapping[str, float], dx: float) -> float:
        """Return the largest stable time step [s] on a grid of spacing dx.

        The kernel of a single particle has the second moment dx^2 / 4 at any position. Symplectic Euler is
        stable while K dt^2 + 4 eta dt < dx^2, with the stiffness K and the viscosity eta, at density 1. No
        mode of a body is faster, because the grid mass is a sum over the particles (Irons and Treharne,
        1971).
        """
        found = self.coefficients_of(values)
        stiffness, viscosity = float(self.stiffness(*found)), float(self.viscosity(*found))
        if viscosity == 0.0:
            return dx / math.sqrt(stiffness)
        return dx * dx / (2.0 * viscosity + math.sqrt(4.0 * viscosity**2 + stiffness * dx * dx))

    def parameter_gradient(self, values: Mapping[str, float], bars: Sequence[float]) -> list[float]:
        """Convert derivatives with respect to coefficients to derivatives with respect to parameters."""
        trace = Trace()
        inputs = trace.inputs("values", len(self.parameters))
        own = derivatives(self.coefficients(*inputs), list(bars), inputs)
        given = {node: values[key] for node, key in zip(inputs, self.keys, strict=True)}
        return [float(number) for number in evaluated(own, given)]
