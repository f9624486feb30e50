"""Adjoints of the parts of :mod:`plab.sim.material`, derived from them by tracing.

Numbers may be of any kind, as there. Adjoints are named after what they belong to, with ``_bar``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

from tracing import Primitive, Trace, derivatives, evaluated

from plab.sim import linalg, material

__all__ = ["flow_adjoint", "strain_adjoint", "stress_adjoint"]


class TracedSeries(linalg.Series):
    """The series, with the derivative of J^(-2/3) instead of that of Newton's steps."""

    def unimodular_scale(self, j: Any) -> Any:
        own = linalg.Series.unimodular_scale
        return j.trace.node(Primitive(lambda j: own(self, j), lambda c2, j: (-2.0 / 3.0) * c2 / j), j)


def stress_adjoint(
    d: Sequence[Any],
    j: Any,
    c2: Any,
    parameters: Sequence[Any],
    a_bar: Sequence[Any],
    stress_scale: Any,
    series: linalg.Series,
) -> tuple[list[Any], Any, Any, list[Any]]:
    """Return the adjoints of d (6), c2, J and the parameters (3) by the stress, from that of A (9)."""
    trace = Trace()
    inputs = [*trace.inputs("d", 6), *trace.inputs("scalars", 2), *trace.inputs("parameters", 3)]
    bars, [scale] = trace.inputs("a_bar", 9), trace.inputs("scale", 1)
    tau = material.stress(inputs[:6], inputs[7], inputs[6], *inputs[8:], series)
    a = material.scattered_matrix(tau, [0.0] * 9, scale, 0.0)
    given = dict(zip([*inputs, *bars, scale], [*d, c2, j, *parameters, *a_bar, stress_scale], strict=True))
    out = evaluated(derivatives(a, bars, inputs), given)
    return out[:6], out[6], out[7], out[8:]


def flow_adjoint(
    d: Sequence[Any], g: Sequence[Any], yield_strain: Any, f_bar: Sequence[Any], series: linalg.Series
) -> tuple[list[Any], list[Any], Any]:
    """Return the adjoints of d (6), G (9) and the yield strain by plastic flow, from that of the new F."""
    trace = Trace()
    inputs = [*trace.inputs("d", 6), *trace.inputs("g", 9), *trace.inputs("yield_strain", 1)]
    bars = trace.inputs("f_bar", 9)
    f = material.flow(inputs[:6], inputs[6:15], inputs[15], series)
    given = dict(zip([*inputs, *bars], [*d, *g, yield_strain, *f_bar], strict=True))
    out = evaluated(derivatives(f, bars, inputs), given)
    return out[:6], out[6:15], out[15]


def strain_adjoint(
    c: Sequence[Any],
    f: Sequence[Any],
    dt: Any,
    known: Sequence[Any],
    bars: Sequence[Any],
    series: linalg.Series,
) -> tuple[list[Any], list[Any]]:
    """Return the adjoints of C and F (9 each) by the strain.

    Args:
        c: C.
        f: F.
        dt: Time step [s].
        known: G (9), J, c2, W (6), Z (6), a1, a2 and d (6), as computed from C and F.
        bars: Adjoints of G (9), J, c2 and d (6).
        series: Numbers of terms.
    """
    trace = Trace()
    inputs, [step] = trace.inputs("c", 9) + trace.inputs("f", 9), trace.inputs("dt", 1)
    g = material.trial_gradient(inputs[:9], inputs[9:], step)
    j = linalg.det(g)
    c2, w, z, _z_squared, a1, a2, d = material.hencky_strain(g, j, TracedSeries(*astuple(series)))
    own = trace.inputs("bars", 17)
    given = dict(zip([*inputs, step, *own], [*c, *f, dt, *bars], strict=True))
    given |= dict(zip([*g, j, c2, *w, *z, a1, a2, *d], known, strict=True))
    out = evaluated(derivatives([*g, j, c2, *d], own, inputs), given)
    return out[:9], out[9:]
