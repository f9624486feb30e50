"""Sand: Hencky elasticity with Drucker-Prager plasticity (Klar et al., 2016).

Sand carries shear up to a multiple of its pressure: with the principal Hencky strains e of the trial state,
the norm of the deviator is limited to ``-alpha (3 lambda + 2 mu) / (2 mu) tr e``, at constant volume. States
with a positive trace carry no stress.

F stores the volumetric expansion of separated sand, so that it carries pressure only after returning to its
original volume: the volume correction of Tampubolon et al. (2017).
"""

import math

import numpy as np

from plab.laws.algebra import mul_sym_mat, outer_sym, total, trial_gradient
from plab.laws.elastic import ELASTIC, lame
from plab.laws.law import Law, Parameter
from plab.laws.principal import PrincipalFrame

SQUARE_MIN = 0.0025
"""Squares of stretches are clamped from below before the logarithm."""

NORM_SHIFT = 1e-16
"""Added to the squared norm of the deviator, because the derivative of the root is infinite at 0."""


def hencky(c, f, dt):
    """Trial F, principal frame, and trace, deviator (3) and its norm of the principal Hencky strains."""
    g = trial_gradient(c, f, dt)
    frame = PrincipalFrame(outer_sym(g))
    strain = [0.5 * np.log(np.maximum(value, SQUARE_MIN)) for value in frame.values]
    trace = total(strain)
    deviator = [e - trace * (1.0 / 3.0) for e in strain]
    return g, frame, trace, deviator, np.sqrt(total(e * e for e in deviator) + NORM_SHIFT)


def update(c, f, dt, mu, lam, alpha):
    """Return the Kirchhoff stress, and F after the substep."""
    g, frame, trace, deviator, norm = hencky(c, f, dt)
    pressed = np.minimum(trace, 0.0)
    k = np.minimum(-(1.5 * lam / mu + 1.0) * alpha * pressed / norm, 1.0)
    pressure = (lam + (2.0 / 3.0) * mu) * pressed
    tau = frame.tensor([2.0 * mu * (k * e) + pressure for e in deviator], (trace, k))
    flow = frame.tensor([np.exp((k - 1.0) * e) for e in deviator], (trace, k))
    return tau, mul_sym_mat(flow, g)


def coefficients(youngs_modulus, poisson_ratio, friction_angle):
    """Lamé's parameters and alpha = sqrt(2/3) 2 sin(phi) / (3 - sin(phi))."""
    sine = sin_degrees(friction_angle)
    return *lame(youngs_modulus, poisson_ratio), math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)


def sin_degrees(angle):
    """Sine of an angle [degrees] up to 90, by its series."""
    x = angle * (math.pi / 180.0)
    out, square = 0.0 * x, x * x
    for k in reversed(range(1, 12)):
        out = (1.0 + out) * square * (-1.0 / (2 * k * (2 * k + 1)))
    return x * (1.0 + out)


DRUCKER_PRAGER = Law(
    name="drucker_prager",
    parameters=(
        *ELASTIC.parameters,
        Parameter("friction_angle", 35.0, "[0, 90)", "degrees", "angle of internal friction"),
    ),
    update=update,
    coefficients=coefficients,
    stiffness=lambda mu, lam, _alpha: 3.0 * lam + 2.0 * mu,
)
