"""Contact terms: three functions of the distances d_p between a moving manipulator and all particles p.

* ``nearest``: ``D^2``, D the distance of the nearest particle, and its gradient.
* ``all``: the same measure, with ``2 D sum grad d_p`` over all particles outside as gradient, which is not
  the gradient of any function.
* ``soft``: ``D^2``, D the mean of the d_p with weights ``1 / (1 + 1e4 d_p^2)``, and its gradient.

Distances are 0 inside a manipulator. Each term is summed over the moving manipulators.
"""

from plab.losses.term import DistanceTerm
from plab.sim.compiler import ti

FAR = 1e9
"""Initial value for the distance of the nearest particle [domain units]."""

SHARPNESS = 1e4
"""Decay of the soft minimum's weights with the squared distance [1 / domain units^2], as in the PlasticineLab
release."""


class NearestContact(DistanceTerm):
    """Squared distance to the nearest particle; ties are broken by order."""

    name = "contact"
    label = "squared distances of the moving manipulators to the nearest particle"
    unit = "domain units^2"
    nearest_only = True

    @ti.func
    def start(self):
        """Initial accumulator: a large distance, and no particle."""
        return ti.Vector([FAR, 0.0], ti.f64)

    @ti.func
    def add(self, accumulator, d, particle):
        """Keep the nearer particle."""
        out = accumulator
        if ti.cast(d, ti.f64) < accumulator[0]:
            out = ti.Vector([ti.cast(d, ti.f64), ti.cast(particle, ti.f64)])
        return out

    @ti.func
    def join(self, accumulator, other):
        """Keep the nearer particle."""
        out = accumulator
        if other[0] < accumulator[0] or (other[0] == accumulator[0] and other[1] < accumulator[1]):
            out = other
        return out

    @ti.func
    def measure(self, accumulator):
        """Squared distance D^2."""
        nearest = ti.max(accumulator[0], 0.0)
        return nearest * nearest

    @ti.func
    def slope(self, accumulator, d, particle):
        """Derivative 2 D for the nearest particle, 0 for the others."""
        out = 0.0 * accumulator[0]
        if ti.cast(particle, ti.f64) == accumulator[1]:
            out = 2.0 * ti.max(accumulator[0], 0.0)
        return out


class AllContact(NearestContact):
    """Squared nearest distance; in the adjoint, every particle outside receives the derivative of the nearest
    one.

    The release differentiates an atomic minimum like an addition. The result attracts a manipulator to the
    whole body, ten thousand times as strongly as the true gradient.
    """

    label = f"{NearestContact.label}; gradient summed over all particles"
    nearest_only = False

    @ti.func
    def slope(self, accumulator, d, particle):
        """Derivative 2 D for all particles outside."""
        out = 0.0 * accumulator[0]
        if d > 0.0:
            out = 2.0 * ti.max(accumulator[0], 0.0)
        return out


class SoftContact(DistanceTerm):
    """Squared weighted mean of the distances, dominated by nearby particles."""

    name = "contact"
    label = "squared soft minima of the moving manipulators' distances to the particles"
    unit = "domain units^2"

    @ti.func
    def add(self, accumulator, d, particle):
        """Sums of the weights, and of the weights times the distances."""
        outside = ti.max(ti.cast(d, ti.f64), 0.0)
        w = 1.0 / (1.0 + SHARPNESS * outside * outside)
        return accumulator + ti.Vector([w, w * outside])

    @ti.func
    def measure(self, accumulator):
        """Squared mean distance D^2."""
        mean = accumulator[1] / accumulator[0]
        return mean * mean

    @ti.func
    def slope(self, accumulator, d, particle):
        """Derivative 2 D dD/dd, with dD/dd = (w + w' (d - D)) / sum w."""
        out = 0.0 * accumulator[0]
        if d > 0.0:
            outside = ti.cast(d, ti.f64)
            mean = accumulator[1] / accumulator[0]
            w = 1.0 / (1.0 + SHARPNESS * outside * outside)
            out = 2.0 * mean * (w - 2.0 * SHARPNESS * outside * w * w * (outside - mean)) / accumulator[0]
        return out
