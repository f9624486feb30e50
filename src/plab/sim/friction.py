"""Coulomb friction of what slides along a surface, manipulator or floor, and its adjoint."""

import taichi as ti

__all__ = ["slid", "slid_adjoint"]


@ti.func
def slid(t, rn, friction):
    """Tangential velocity t, a 3-vector or 2-vector in the surface's own axes, after full contact: shortened
    by friction times the normal velocity rn that is lost, which is negative, towards the surface."""
    length = t.norm()
    factor = 0.0 * friction
    if length + rn * friction > 0.0 and length > 0.0:
        factor = 1.0 + rn * friction / length
    return factor * t


@ti.func
def slid_adjoint(t, rn, friction, bar):
    """Adjoints of t and rn under :func:`slid`, given the adjoint of its result."""
    length = t.norm()
    t_bar = t * 0.0
    rn_bar = 0.0 * rn
    if length + rn * friction > 0.0 and length > 0.0:
        factor = 1.0 + rn * friction / length
        along = t.dot(bar) / length
        t_bar = factor * bar - (friction * rn * along / (length * length)) * t
        rn_bar = friction * along
    return t_bar, rn_bar
