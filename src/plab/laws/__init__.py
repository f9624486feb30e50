"""Constitutive laws, one per file: parameters, stress, time step limit."""

from plab.laws.law import Law, Parameter

__all__ = ["Law", "Parameter"]
