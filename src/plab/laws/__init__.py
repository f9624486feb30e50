"""Constitutive laws, one per file: parameters, stress and time step limit."""

from plab.laws.law import Law, Parameter

__all__ = ["Law", "Parameter"]
