"""Articulated models: from actions in joint space to twists of rigid links, and the adjoint back."""

from plab.kinematics.chain import Chain, Joint, Link, ModelError
from plab.kinematics.models import locate_model, read_model

__all__ = ["Chain", "Joint", "Link", "ModelError", "locate_model", "read_model"]
