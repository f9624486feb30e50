"""Coulomb friction of what slides along a surface, manipulator or floor, and its adjoint."""

import taichi as ti

__all__ = ["slid", "slid_adjoint"]


@ti.func
def slid(t, rn, friction, rubs: ti.template()):
    """Tangential velocity after full contact.

    Args:
        t: Tangential velocity before, 3-vector, or 2-vector in the surface's own axes.
        rn: Normal velocity, negative: towards the surface.
        friction: Coulomb friction coefficient.
        rubs: Whether any coefficient is positive; decided while compiling.

    Returns:
        t, shortened by friction times the normal velocity that is lost.
    """
    out = t
    if ti.static(rubs):
        length = t.norm()
        factor = 0.0 * friction
        if length + rn * friction > 0.0 and length > 0.0:
            factor = 1.0 + rn * friction / length
        out = factor * t
    return out


@ti.func
def slid_adjoint(t, rn, friction, rubs: ti.template(), bar):
    """Adjoints of t and rn under :func:`slid`, given the adjoint of its result."""
    length = t.norm()
    t_bar = t * 0.0
    rn_bar = 0.0 * rn
    if ti.static(not rubs):
        if length > 0.0:
            t_bar = bar
    elif length + rn * friction > 0.0 and length > 0.0:
        factor = 1.0 + rn * friction / length
        along = t.dot(bar) / length
        t_bar = factor * bar - (friction * rn * along / (length * length)) * t
        rn_bar = friction * along
    return t_bar, rn_bar
