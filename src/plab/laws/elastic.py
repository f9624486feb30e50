"""Neo-Hookean elasticity: tau = mu (b - I) + lambda J (J - 1) I, with b = F F^T and J = det F.

A polynomial of F, also valid for inverted particles.
"""

from plab.laws.algebra import det, outer_sym, trial_gradient
from plab.laws.law import Law, Parameter


def lame(youngs_modulus, poisson_ratio):
    """Lame's parameters mu and lambda."""
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def update(c, f, dt, mu, lam):
    """Return the Kirchhoff stress, and F after the substep."""
    g = trial_gradient(c, f, dt)
    j, b = det(g), outer_sym(g)
    pressure = lam * j * (j - 1.0)
    return [mu * (b[i] - 1.0) + pressure if i < 3 else mu * b[i] for i in range(6)], g


ELASTIC = Law(
    name="elastic",
    parameters=(
        Parameter("youngs_modulus", 5000.0, "(0, inf)", "Pa", "Young's modulus"),
        Parameter("poisson_ratio", 0.2, "[0, 0.5)", "", "Poisson ratio"),
    ),
    update=update,
    coefficients=lame,
    stiffness=lambda mu, lam: 3.0 * lam + 2.0 * mu,
)
