"""Constitutive laws, a file each: parameters, stress, limit of the time step."""

from plab.laws.law import Law, Parameter

__all__ = ["Law", "Parameter"]
