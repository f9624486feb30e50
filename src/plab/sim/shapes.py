"""Signed distances of manipulators in their own frames, with normals and Hessian-vector products.

:data:`SURFACES` has the functions of each shape of :data:`plab.scenes.MANIPULATOR_SHAPES`. All distances are
exact, as required by the broad phase, so normals have length 1, except 0 at centres and axes of round shapes.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from plab.scenes import MANIPULATOR_SHAPES, SceneError
from plab.sim.compiler import ti


@dataclass(frozen=True)
class Surface:
    """Functions of a shape for contact.

    The functions take a local point [domain units], 3-vector; the shape's lengths in the order of
    ``MANIPULATOR_SHAPES[shape].size_names``, padded to a 3-vector; and the gap.

    Attributes:
        distance: Distance d, negative inside, and outward normal n = grad d, 3-vector.
        hessian_product: Hessian of d times a 3-vector, the last argument.
        gap_slope: Derivative of the x coordinate of the local point, relative to the nearest part of the
            shape, with respect to the gap; only for motions that change the gap.
        round: Whether the shape is invariant under rotations.
    """

    distance: Callable
    hessian_product: Callable
    gap_slope: Any = None
    round: bool = False


# -- bodies around points and segments --------------------------------------------------------------------


@ti.func
def ball(q, r):
    """Distance and normal of a ball of radius r at the origin."""
    length = q.norm()
    n = q / ti.max(length, 1e-12)
    return length - r, n


@ti.func
def ball_hessian_product(q, w):
    length = ti.max(q.norm(), 1e-12)
    n = q / length
    return (w - n * n.dot(w)) / length


@ti.func
def rod_hessian_product(q, w):
    """Hessian-vector product of the distance from a segment on the y axis; q is the offset from it."""
    masked = w
    # Along the straight part the distance does not depend on y.
    if q[1] == 0.0:
        masked[1] = 0.0
    return ball_hessian_product(q, masked)


@ti.func
def on_segment(p, low, high):
    """p relative to the nearest point of the segment from low to high on the y axis."""
    return ti.Vector([p[0], p[1] - ti.min(ti.max(p[1], low), high), p[2]])


@ti.func
def sphere_distance(p, size, _gap):
    """Sphere of radius size[0]."""
    return ball(p, size[0])


@ti.func
def sphere_hessian_product(p, _size, _gap, w):
    return ball_hessian_product(p, w)


@ti.func
def capsule_distance(p, size, _gap):
    """Capsule about y: length size[0] between its ends' centres, radius size[1]."""
    return ball(on_segment(p, -0.5 * size[0], 0.5 * size[0]), size[1])


@ti.func
def capsule_hessian_product(p, size, _gap, w):
    return rod_hessian_product(on_segment(p, -0.5 * size[0], 0.5 * size[0]), w)


@ti.func
def nearer_stick(p):
    """Sign of the local x offset of the chopstick nearer to p."""
    return ti.select(p[0] < 0.0, -1.0, 1.0)


@ti.func
def stick_point(p, size, gap):
    """p relative to the nearest point of the nearer chopstick's axis."""
    side = nearer_stick(p)
    return on_segment(p - ti.Vector([0.5 * side * gap, 0.0, 0.0]), -size[0], 0.0 * gap)


@ti.func
def chopsticks_distance(p, size, gap):
    """Two capsules along local -y of length size[0] and radius size[1], whose axes are the gap apart."""
    return ball(stick_point(p, size, gap), size[1])


@ti.func
def chopsticks_hessian_product(p, size, gap, w):
    return rod_hessian_product(stick_point(p, size, gap), w)


@ti.func
def chopsticks_gap_slope(p):
    """Derivative of the x coordinate of :func:`stick_point` with respect to the gap."""
    return -0.5 * nearer_stick(p)


# -- sets of points whose coordinates are bounded ---------------------------------------------------------


@ti.func
def solid(q, half):
    """Exact distance and normal of the set |q_i| <= half_i for a vector of 2 or 3 coordinates."""
    excess = ti.abs(q) - half
    out = ti.max(excess, 0.0)
    length = out.norm()
    d = length
    n = q * 0.0
    if length > 0.0:
        for i in ti.static(range(q.n)):
            n[i] = ti.select(q[i] < 0.0, -out[i], out[i]) / length
    else:
        d = excess.max()
        taken = 0
        for i in ti.static(range(q.n)):
            if taken == 0 and excess[i] == d:
                n[i] = ti.select(q[i] < 0.0, -1.0, 1.0)
                taken = 1
    return d, n


@ti.func
def solid_hessian_product(q, half, w):
    out = ti.max(ti.abs(q) - half, 0.0)
    length = out.norm()
    h = q * 0.0
    if length > 0.0:
        n = q * 0.0
        masked = q * 0.0
        for i in ti.static(range(q.n)):
            if out[i] > 0.0:
                n[i] = ti.select(q[i] < 0.0, -out[i], out[i]) / length
                masked[i] = w[i]
        h = (masked - n * n.dot(masked)) / length
    return h


@ti.func
def box_distance(p, size, _gap):
    """Box of half edges ``size``."""
    return solid(p, size)


@ti.func
def box_hessian_product(p, size, _gap, w):
    return solid_hessian_product(p, size, w)


# -- bodies of revolution about y -------------------------------------------------------------------------


@ti.func
def planar(axial, radial_x, radial_z):
    """Guarded radius in the xz plane, and the unit radial direction."""
    rho = ti.sqrt(radial_x * radial_x + radial_z * radial_z)
    safe = ti.max(rho, 1e-12)
    return rho, safe, ti.Vector([radial_x / safe, 0.0 * axial, radial_z / safe])


@ti.func
def revolved(m, radial):
    """Normal of a body of revolution, given its profile's normal m."""
    n = m[0] * radial
    n[1] = m[1]
    return n


@ti.func
def revolved_hessian_product(m, h, safe, radial, w):
    """Hessian-vector product of a body of revolution, given its profile's normal m and product h."""
    tangent = ti.Vector([-radial[2], 0.0 * safe, radial[0]])
    out = h[0] * radial + m[0] / safe * tangent.dot(w) * tangent
    out[1] = h[1]
    return out


@ti.func
def torus_distance(p, size, _gap):
    """Torus: major radius size[0], minor radius size[1]."""
    rho, _safe, radial = planar(p[1], p[0], p[2])
    d, m = ball(ti.Vector([rho - size[0], p[1]]), size[1])
    return d, revolved(m, radial)


@ti.func
def torus_hessian_product(p, size, _gap, w):
    rho, safe, radial = planar(p[1], p[0], p[2])
    q = ti.Vector([rho - size[0], p[1]])
    _d, m = ball(q, size[1])
    h = ball_hessian_product(q, ti.Vector([radial.dot(w), w[1]]))
    return revolved_hessian_product(m, h, safe, radial, w)


@ti.func
def cylinder_distance(p, size, _gap):
    """Cylinder of radius size[0] and half height size[1]."""
    rho, _safe, radial = planar(p[1], p[0], p[2])
    d, m = solid(ti.Vector([rho, p[1]]), ti.Vector([size[0], size[1]]))
    return d, revolved(m, radial)


@ti.func
def cylinder_hessian_product(p, size, _gap, w):
    rho, safe, radial = planar(p[1], p[0], p[2])
    q = ti.Vector([rho, p[1]])
    half = ti.Vector([size[0], size[1]])
    _d, m = solid(q, half)
    h = solid_hessian_product(q, half, ti.Vector([radial.dot(w), w[1]]))
    return revolved_hessian_product(m, h, safe, radial, w)


# -- by name ----------------------------------------------------------------------------------------------

SURFACES: dict[str, Surface] = {
    "Sphere": Surface(sphere_distance, sphere_hessian_product, round=True),
    "Capsule": Surface(capsule_distance, capsule_hessian_product),
    "Chopsticks": Surface(chopsticks_distance, chopsticks_hessian_product, chopsticks_gap_slope),
    "Torus": Surface(torus_distance, torus_hessian_product),
    "Cylinder": Surface(cylinder_distance, cylinder_hessian_product),
    "Box": Surface(box_distance, box_hessian_product),
}
"""Surface of each shape of :data:`plab.scenes.MANIPULATOR_SHAPES`."""

SURFACES |= {name: SURFACES[kind.outline] for name, kind in MANIPULATOR_SHAPES.items() if kind.outline}


def require_surfaces(shapes: Iterable[str]) -> None:
    """Raise SceneError if a shape has no surface, or a gripper no derivative with respect to its gap."""
    for shape in shapes:
        surface = SURFACES.get(shape)
        if surface is None or (MANIPULATOR_SHAPES[shape].grips and surface.gap_slope is None):
            raise SceneError(f"shape '{shape}': complete SURFACES['{shape}'] in plab/sim/shapes.py")
