"""Articulated models: forward kinematics from joint-space actions to twists of rigid links, and its
adjoint."""

from plab.kinematics.chain import Chain, Joint, Link, ModelError
from plab.kinematics.models import locate_model, read_model

__all__ = ["Chain", "Joint", "Link", "ModelError", "locate_model", "read_model"]
