"""Articulated models: forward kinematics from joint-space actions to link twists, and its adjoint."""

from plab.kinematics.chain import Chain, Joint, Link, ModelError
from plab.kinematics.models import locate_model, read_model

__all__ = ["Chain", "Joint", "Link", "ModelError", "locate_model", "read_model"]
