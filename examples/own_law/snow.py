"""Snow: elastic up to a critical compression and stretch, plastic beyond (after Stomakhin et al., 2013)."""

import numpy as np

from plab.laws import Law, Parameter
from plab.laws.algebra import mul_sym_mat, outer_sym, trial_gradient
from plab.laws.elastic import ELASTIC, lame
from plab.laws.principal import PrincipalFrame


def update(c, f, dt, mu, lam, compression, stretch):
    """Return the Kirchhoff stress, and F after the substep."""
    g = trial_gradient(c, f, dt)
    frame = PrincipalFrame(outer_sym(g))
    trial = [np.sqrt(np.maximum(square, 1e-4)) for square in frame.values]
    kept = [np.minimum(np.maximum(s, 1.0 - compression), 1.0 + stretch) for s in trial]
    j = kept[0] * kept[1] * kept[2]
    tau = frame.tensor([2.0 * mu * (s - 1.0) * s + lam * (j - 1.0) * j for s in kept])
    return tau, mul_sym_mat(frame.tensor([s / t for s, t in zip(kept, trial, strict=True)]), g)


def coefficients(youngs_modulus, poisson_ratio, compression, stretch):
    """Lame's parameters, and the critical strains."""
    return *lame(youngs_modulus, poisson_ratio), compression, stretch


SNOW = Law(
    name="snow",
    parameters=(
        *ELASTIC.parameters,
        Parameter("compression", 0.025, "(0, 1)", "", "largest elastic compression"),
        Parameter("stretch", 0.0075, "(0, 1)", "", "largest elastic stretch"),
    ),
    update=update,
    coefficients=coefficients,
    stiffness=lambda mu, lam, *_: 3.0 * lam + 2.0 * mu,
)
