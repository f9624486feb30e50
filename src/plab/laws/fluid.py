"""Weakly compressible viscous fluid: tau = -p J I + 2 eta J dev D, with p = K (1 - J).

D is the symmetric part of C.
F stores only the volume ratio, as diag(J, 1, 1).
"""

from plab.laws.algebra import SYM, det, trial_gradient
from plab.laws.law import Law, Parameter


def update(c, f, dt, bulk_modulus, viscosity):
    """Return the Kirchhoff stress, and F after the substep."""
    j = det(trial_gradient(c, f, dt))
    pressure = bulk_modulus * j * (j - 1.0)
    mean = (c[0] + c[4] + c[8]) * (1.0 / 3.0)
    shear = viscosity * j
    tau = [pressure + 2.0 * shear * (c[4 * i] - mean) for i in range(3)]
    tau += [shear * (c[3 * i + k] + c[3 * k + i]) for i, k in SYM[3:]]
    return tau, [j, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


FLUID = Law(
    name="fluid",
    parameters=(
        Parameter("bulk_modulus", 5000.0, "(0, inf)", "Pa", "bulk modulus, the square of the speed of sound"),
        Parameter("viscosity", 0.1, "[0, inf)", "Pa s", "dynamic viscosity"),
    ),
    update=update,
    stiffness=lambda bulk_modulus, _viscosity: 3.0 * bulk_modulus,
    viscosity=lambda _bulk_modulus, viscosity: viscosity,
)
