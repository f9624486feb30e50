"""Operations that the simulator's functions do, counted by running them with numbers that count.

Taichi keeps the Python function behind each of its own. Here they run as plain Python, with a stand-in for
what they use of Taichi, on numbers each of whose operations adds one to a count. Multiplication by a literal
0 or 1 and addition of a literal 0 do not count: the compiler removes them.
"""

from __future__ import annotations

import inspect
import types
from collections import defaultdict
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from plab.sim import linalg, material, transfer
from plab.sim.particle_phases import ParticlePhases
from plab.sim.series import Series

__all__ = ["particle_operations"]


class Counting:
    """A number that counts what is done with it; all that is done gives another one."""

    operations = 0

    def __init__(self, value: float = 0.5) -> None:
        self.value = value

    def _with(self, other: Counting | float, neutral: tuple[float, ...]) -> Counting:
        if not (isinstance(other, int | float) and other in neutral):
            Counting.operations += 1
        return Counting()

    def __add__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else self._with(other, (0,))

    def __mul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else self._with(other, (0, 1))

    def __truediv__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else self._with(other, (1,))

    __radd__ = __sub__ = __rsub__ = __add__
    __rmul__ = __mul__
    __rtruediv__ = __truediv__

    def __neg__(self) -> Counting:
        return self

    def __lt__(self, other: object) -> bool:
        return False


def _count(*_arguments: object) -> Counting:
    Counting.operations += 1
    return Counting()


_TAICHI = SimpleNamespace(
    static=lambda value: value,
    template=lambda: None,
    sqrt=_count,
    min=_count,
    max=_count,
    select=_count,
    Vector=lambda values: np.array(values, dtype=object),
)
"""What the counted functions use of Taichi."""

_modules: dict[int, dict[str, Any]] = {}


def plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the Python function behind one of Taichi's; what it calls is plain, too."""
    inner = inspect.unwrap(function)
    return types.FunctionType(
        inner.__code__, _namespace(inner.__globals__), inner.__name__, inner.__defaults__, inner.__closure__
    )


def _namespace(names: dict[str, Any]) -> dict[str, Any]:
    """Return a module's names with Taichi replaced and its functions plain."""
    if id(names) not in _modules:
        _modules[id(names)] = copy = dict(names)
        for name, value in names.items():
            if getattr(value, "_is_taichi_function", False):
                copy[name] = plain(value)
        copy["ti"] = _TAICHI
    return _modules[id(names)]


def _counted(call: Callable[[], object]) -> int:
    Counting.operations = 0
    call()
    return Counting.operations


def _numbers(count: int) -> list[Counting]:
    return [Counting() for _ in range(count)]


def _vector(count: int) -> np.ndarray:
    return np.array(_numbers(count), dtype=object)


@cache
def particle_operations(precision: str) -> dict[str, int]:
    """Operations per particle and substep in each phase that runs over particles, manipulators aside.

    Args:
        precision: ``float32`` or ``float64``; the series have more terms in the latter.

    Returns:
        Counts for ``scatter`` (with the material update), ``gather``, and their adjoints.
    """
    material_forward = _counted(lambda: _stress(precision))
    gathering = _counted(_gather)
    scattering = _counted(_scatter)
    return {
        "scatter": material_forward + scattering,
        "gather": gathering,
        "scatter adjoint": material_forward + 2 * scattering,
        "gather adjoint": _counted(_gather_adjoint) + _counted(lambda: _stress_adjoint(precision)),
    }


def _stress(precision: str) -> None:
    """Trial gradient, strain, stress and A; as ParticlePhases.material_particle."""
    series = Series.for_precision(precision)
    c = _numbers(9)
    g = plain(material.trial_gradient)(c, _numbers(9), Counting())
    j = plain(linalg.det)(g)
    c2, *_rest, d = plain(material.hencky_strain)(g, j, series)
    tau = plain(material.stress)(d, j, c2, Counting(), Counting(), Counting(), series)
    scene = SimpleNamespace(stress_scale=Counting(), mass=Counting())
    plain(ParticlePhases.stress_and_momentum)(scene, tau, c)


def _stress_adjoint(precision: str) -> None:
    """Adjoint of the same without plastic flow; as ParticlePhases.material_particle_adjoint."""
    series = Series.for_precision(precision)
    c, f = _numbers(9), _numbers(9)
    dt, mu, lam, strain = _numbers(4)
    g = plain(material.trial_gradient)(c, f, dt)
    j = plain(linalg.det)(g)
    c2, w, z, _z2, a1, a2, d = plain(material.hencky_strain)(g, j, series)
    tau_bar = plain(ParticlePhases.stress_symmetric)(SimpleNamespace(stress_scale=Counting()), _numbers(9))
    d_bar, k_bar, c2_bar, j_bar = plain(material.stress_adjoint)(d, j, c2, tau_bar, mu, lam, strain, series)
    z_bar = plain(material.log_adjoint)(z, a1, a2, d, d_bar, k_bar, strain, series)
    plain(material.strain_adjoint)(c, f, g, j, c2, w, z_bar, c2_bar, j_bar, _numbers(9), dt)


def _scatter() -> None:
    """Weights, the affine field and its sums at 27 nodes; as TransferTiles.scatter_momentum."""
    grid: dict[int, np.ndarray] = defaultdict(lambda: _vector(4))
    work: dict[int, np.ndarray] = defaultdict(lambda: _vector(4))
    fx = _vector(3)
    field = plain(transfer.affine_field)(Counting() * _vector(3), Counting(), _numbers(9), fx, Counting())
    plain(transfer.scatter)(grid, 0, 100, 10, plain(transfer.spline)(fx), field, work, 0)


def _gather() -> None:
    """Sums over 27 nodes, and v, C and x from them; as TransferTiles.gather_particle."""
    grid: dict[int, np.ndarray] = defaultdict(lambda: _vector(4))
    work: dict[int, np.ndarray] = defaultdict(lambda: _vector(4))
    fx = _vector(3)
    plain(transfer.gather)(grid, 0, 100, 10, plain(transfer.spline)(fx), work, 0)
    # C: three times (sum - fx v) scaled, per component; x: x + dt v, clamped; the speed.
    Counting.operations += 3 * (3 * 3 + 4 + 2)


def _gather_adjoint() -> None:
    """What a particle's adjoint needs of the grid; as TransferTiles.gather_particle_adjoint."""
    grid: dict[int, np.ndarray] = defaultdict(lambda: _vector(4))
    work: dict[int, np.ndarray] = defaultdict(lambda: _vector(4))
    fx = _vector(3)
    for _field in range(2):
        plain(transfer.affine_field)(Counting() * _vector(3), Counting(), _numbers(9), fx, Counting())
    weights, slopes = plain(transfer.spline)(fx), plain(transfer.spline_slope)(fx)
    plain(transfer.gather_adjoint)(grid, grid, 0, 100, 10, weights, slopes, work, 0)
    # Slopes summed, offsets by C_bar and A, adjoints of x and v, and nine entries of A's.
    Counting.operations += 3 * (3 + 12 + 3 + 1) + 9 * 3
