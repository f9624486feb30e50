"""What the kernels' material parameters are made of: Young's modulus, Poisson ratio and yield stress."""

from __future__ import annotations

import numpy as np

from plab.scene import Material

__all__ = ["YIELD_STRAIN_MAX", "material_parameters", "parameter_gradient"]

YIELD_STRAIN_MAX = 1e30
"""Stands for infinity, which would turn the unused branch into infinity times zero."""


def material_parameters(material: Material) -> tuple[float, float, float]:
    """Shear modulus mu, Lame's lambda, and yield strain (yield stress / 2 mu)."""
    mu = material.shear_modulus
    return mu, material.lame_lambda, min(material.yield_stress / (2.0 * mu), YIELD_STRAIN_MAX)


def parameter_gradient(material: Material, bars: np.ndarray) -> np.ndarray:
    """Turn derivatives with respect to :func:`material_parameters` into those with respect to the material's.

    Args:
        material: The material.
        bars: Derivatives with respect to mu, lambda and yield strain, shape [3].

    Returns:
        Derivatives with respect to Young's modulus, Poisson ratio and yield stress, shape [3].
    """
    young, nu = material.youngs_modulus, material.poisson_ratio
    mu, lam, strain = material_parameters(material)
    by_young = np.array([mu, lam, -strain]) / young
    lam_by_nu = young * (1.0 + 2.0 * nu**2) / ((1.0 + nu) * (1.0 - 2.0 * nu)) ** 2
    by_nu = np.array([-mu / (1.0 + nu), lam_by_nu, strain / (1.0 + nu)])
    by_yield = np.array([0.0, 0.0, 0.5 / mu])
    if strain >= YIELD_STRAIN_MAX:
        by_young[2] = by_nu[2] = by_yield[2] = 0.0
    return np.stack([by_young, by_nu, by_yield]) @ bars
