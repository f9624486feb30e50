"""Signed distances of the manipulators in their own frames, with what the adjoint of contact needs of them.

Every shape is three functions of a local point: the distance d, the outward normal n = grad d, and the
product of the Hessian of d with a vector. They are all exact distances, so |n| = 1 and the broad phase may
rely on it.
"""

import taichi as ti

__all__ = ["gap_slope", "hessian_product", "signed_distance"]


@ti.func
def planar(axial, radial_x, radial_z):
    """Radius in the xz plane, guarded, and the unit radial direction."""
    rho = ti.sqrt(radial_x * radial_x + radial_z * radial_z)
    safe = ti.max(rho, 1e-12)
    return rho, safe, ti.Vector([radial_x / safe, 0.0 * axial, radial_z / safe])


@ti.func
def ball(q, r):
    """Distance and normal of a ball of radius r at the origin."""
    length = q.norm()
    n = q / ti.max(length, 1e-12)
    return length - r, n


@ti.func
def on_segment(p, low, high):
    """p relative to the nearest point of the segment of the y axis from low to high."""
    return ti.Vector([p[0], p[1] - ti.min(ti.max(p[1], low), high), p[2]])


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
    """Hessian of :func:`solid` times w."""
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
def nearer_stick(p):
    """Sign of the own x offset of the chopstick nearer to p."""
    return ti.select(p[0] < 0.0, -1.0, 1.0)


@ti.func
def stick_point(p, size, gap):
    """p relative to the nearest point of the nearer chopstick's axis."""
    side = nearer_stick(p)
    return on_segment(p - ti.Vector([0.5 * side * gap, 0.0, 0.0]), -size[0], 0.0 * gap)


@ti.func
def gap_slope(shape: ti.template(), p):
    """Derivative of the local point's x, relative to the nearer chopstick, with respect to the gap."""
    out = 0.0 * p[0]
    if ti.static(shape == "Chopsticks"):
        out = -0.5 * nearer_stick(p)
    return out


@ti.func
def signed_distance(shape: ti.template(), p, size, gap):
    """Distance and outward normal of a shape in its own frame.

    Args:
        shape: Name of the shape.
        p: Local point [domain units], 3-vector.
        size: Lengths in the order of ``MANIPULATOR_SHAPES[shape].size_names``, padded to a 3-vector.
        gap: Distance between the chopsticks' axes.

    Returns:
        d and n (3-vector).
    """
    d = 0.0 * p[0]
    n = p * 0.0
    if ti.static(shape == "Sphere"):
        d, n = ball(p, size[0])
    elif ti.static(shape in ("Capsule", "RollingPin")):
        d, n = ball(on_segment(p, -0.5 * size[0], 0.5 * size[0]), size[1])
    elif ti.static(shape == "Chopsticks"):
        d, n = ball(stick_point(p, size, gap), size[1])
    elif ti.static(shape == "Torus"):
        rho, _safe, radial = planar(p[1], p[0], p[2])
        q = ti.Vector([rho - size[0], p[1]])
        length = q.norm()
        m = q / ti.max(length, 1e-12)
        d = length - size[1]
        n = m[0] * radial
        n[1] = m[1]
    elif ti.static(shape == "Cylinder"):
        rho, _safe, radial = planar(p[1], p[0], p[2])
        dist, m = solid(ti.Vector([rho, p[1]]), ti.Vector([size[0], size[1]]))
        d = dist
        n = m[0] * radial
        n[1] = m[1]
    else:
        d, n = solid(p, size)
    return d, n


@ti.func
def revolved_hessian_product(m, h, safe, radial, w):
    """Hessian product of a body of revolution about y from its profile's normal m and Hessian product h."""
    tangent = ti.Vector([-radial[2], 0.0 * safe, radial[0]])
    out = h[0] * radial + m[0] / safe * tangent.dot(w) * tangent
    out[1] = h[1]
    return out


@ti.func
def hessian_product(shape: ti.template(), p, size, gap, w):
    """Hessian of the distance of a shape times w, in its own frame; arguments as for
    :func:`signed_distance`."""
    out = p * 0.0
    if ti.static(shape in ("Torus", "Cylinder")):
        rho, safe, radial = planar(p[1], p[0], p[2])
        w2 = ti.Vector([radial.dot(w), w[1]])
        if ti.static(shape == "Torus"):
            q = ti.Vector([rho - size[0], p[1]])
            length = ti.max(q.norm(), 1e-12)
            m = q / length
            out = revolved_hessian_product(m, (w2 - m * m.dot(w2)) / length, safe, radial, w)
        else:
            q = ti.Vector([rho, p[1]])
            half = ti.Vector([size[0], size[1]])
            _d, m = solid(q, half)
            out = revolved_hessian_product(m, solid_hessian_product(q, half, w2), safe, radial, w)
    elif ti.static(shape == "Box"):
        out = solid_hessian_product(p, size, w)
    else:
        q = p
        if ti.static(shape in ("Capsule", "RollingPin")):
            q = on_segment(p, -0.5 * size[0], 0.5 * size[0])
        elif ti.static(shape == "Chopsticks"):
            q = stick_point(p, size, gap)
        masked = w
        if ti.static(shape != "Sphere"):
            # Along the straight part the distance does not depend on y.
            if q[1] == 0.0:
                masked[1] = 0.0
        length = ti.max(q.norm(), 1e-12)
        n = q / length
        out = (masked - n * n.dot(masked)) / length
    return out
