"""Dough, clay, cream: Hencky elasticity with Herschel-Bulkley flow.

Below the yield stress the body is elastic. Above it, shear stress grows with the rate of plastic flow: in
simple shear by ``consistency * rate^exponent``; with exponent 1 this is a Bingham body with this viscosity.
"""

import math

import numpy as np

from plab.laws.algebra import mul_sym_mat, outer_sym, total, trial_gradient
from plab.laws.drucker_prager import NORM_SHIFT, hencky
from plab.laws.elastic import ELASTIC, lame
from plab.laws.law import Law, Parameter
from plab.laws.principal import PrincipalFrame
from plab.laws.tracing import frozen

NEWTON_STEPS = 6

FLOW_MIN = 1e-30

LEAST = 1e-12
"""Lower bound of the relative overstress before it is raised to a power."""


def update(c, f, dt, mu, lam, yield_stress, consistency, exponent):
    """Return the Kirchhoff stress, and F after the substep."""
    g = trial_gradient(c, f, dt)
    frame = PrincipalFrame(outer_sym(g))
    trace, deviator = hencky(frame)
    norm = np.sqrt(total(e * e for e in deviator) + NORM_SHIFT)
    over = np.maximum(2.0 * mu * norm - yield_stress, 0.0)
    k = 1.0 - (over - overstress(over, dt, mu, consistency, 1.0 / exponent)) / (2.0 * mu * norm)
    pressure = (lam + (2.0 / 3.0) * mu) * trace
    tau = frame.tensor([2.0 * mu * (k * e) + pressure for e in deviator], (trace, k))
    flow = frame.tensor([np.exp((k - 1.0) * e) for e in deviator], (trace, k))
    return tau, mul_sym_mat(flow, g)


def overstress(trial, dt, mu, consistency, power):
    """Overstress x after the substep, given the trial overstress.

    It solves x + sqrt(2) mu dt (x / (sqrt(2) consistency))^power = trial, by Newton's method in x / trial.
    The derivative is taken at the last step.
    """
    scale = np.maximum(trial, LEAST)
    ratio = scale / (math.sqrt(2.0) * consistency)
    flow = math.sqrt(2.0) * mu * dt * np.exp(power * np.log(ratio)) / scale
    # An upper bound of the solution, at which both terms are at most 1.
    x = np.exp(np.minimum(np.log(np.maximum(frozen(flow), FLOW_MIN)) * (-1.0 / frozen(power)), 0.0))
    for step in range(NEWTON_STEPS):
        last = step == NEWTON_STEPS - 1
        b, p = (flow, power) if last else (frozen(flow), frozen(power))
        x = np.maximum(frozen(x), LEAST)
        raised = b * np.exp(p * np.log(x))
        x = x - (x + raised - 1.0) / (1.0 + frozen(p * raised / x))
    return trial * x


def coefficients(youngs_modulus, poisson_ratio, yield_stress, consistency, exponent):
    """Lame's parameters, and the other parameters unchanged."""
    return *lame(youngs_modulus, poisson_ratio), yield_stress, consistency, exponent


VISCOPLASTIC = Law(
    name="viscoplastic",
    parameters=(
        *ELASTIC.parameters,
        Parameter("yield_stress", 50.0, "[0, inf)", "Pa", "norm of the stress deviator at yield"),
        Parameter("consistency", 5.0, "(0, inf)", "Pa s^exponent", "viscosity of the flow"),
        Parameter("exponent", 1.0, "[0.2, 2]", "", "exponent of the rate; 1 is a Bingham body"),
    ),
    update=update,
    coefficients=coefficients,
    stiffness=lambda mu, lam, *_: 3.0 * lam + 2.0 * mu,
)
