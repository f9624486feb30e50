"""Dough, clay, cream: Hencky elasticity with Herschel-Bulkley flow.

Below the yield stress the body is elastic. Above it, shear stress grows with the rate of plastic flow: in
simple shear by ``consistency * rate^exponent``; with exponent 1 this is a Bingham body with this viscosity.
"""

import math

import numpy as np

from plab.laws.algebra import mul_sym_mat
from plab.laws.drucker_prager import hencky
from plab.laws.elastic import ELASTIC, lame
from plab.laws.law import Law, Parameter
from plab.laws.tracing import Node, frozen

HALLEY_STEPS = 3
"""Steps to rounding in float64, for all exponents and rates."""

LEAST = 1e-12
"""Lower bound of the overstress before its logarithm [Pa]."""


def update(c, f, dt, mu, lam, yield_stress, log_consistency, power):
    """Return the Kirchhoff stress, and F after the substep."""
    g, frame, trace, deviator, norm = hencky(c, f, dt)
    over = np.maximum(2.0 * mu * norm - yield_stress, 0.0)
    k = 1.0 - (over - overstress(over, dt, mu, log_consistency, power)) / (2.0 * mu * norm)
    pressure = (lam + (2.0 / 3.0) * mu) * trace
    tau = frame.tensor([2.0 * mu * (k * e) + pressure for e in deviator], (trace, k))
    flow = frame.tensor([np.exp((k - 1.0) * e) for e in deviator], (trace, k))
    return tau, mul_sym_mat(flow, g)


def overstress(trial, dt, mu, log_consistency, power):
    """Overstress x after the substep, given the trial overstress.

    It solves x + sqrt(2) mu dt (x / (sqrt(2) consistency))^power = trial by Halley's method in x / trial,
    with powers from logarithms.
    """
    log_trial = np.log(np.maximum(trial, LEAST))
    log_flow = np.log(math.sqrt(2.0) * mu * dt) - log_trial + power * (log_trial - log_consistency)
    flow, p = frozen(log_flow), frozen(power)
    # An upper bound of the solution, at which both terms are at most 1.
    log_x = np.minimum(-flow / p, 0.0)
    x, raised = np.exp(log_x), np.exp(np.minimum(flow, 0.0))
    for _ in range(HALLEY_STEPS):
        rest, slope = x + raised - 1.0, x + p * raised
        change = 1.0 - rest * slope / (slope * slope - 0.5 * rest * (p * (p - 1.0) * raised))
        x, log_x = x * change, log_x + np.log(change)
        raised = np.exp(p * log_x + flow)
    if isinstance(trial, Node):
        # Zero, with the derivative of the solution.
        x = x - frozen(x * raised / (x + p * raised)) * (log_flow - flow + frozen(log_x) * (power - p))
    return trial * x


def coefficients(youngs_modulus, poisson_ratio, yield_stress, consistency, exponent):
    """Lame's parameters, the yield stress, the logarithm of sqrt(2) consistency, and 1 / exponent."""
    log_consistency = np.log(math.sqrt(2.0) * consistency)
    return *lame(youngs_modulus, poisson_ratio), yield_stress, log_consistency, 1.0 / exponent


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
