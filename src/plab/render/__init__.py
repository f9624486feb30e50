"""Pictures of scenes and rollouts: :class:`Renderer`, and ``plab render`` on the command line.

PyVista, for rendering, is optional: ``pip install 'plab[render]'``. docs/rendering.md has the details.
"""

from typing import Any

from plab.render.camera import View, fit_camera
from plab.render.graphics import RenderError, require_graphics
from plab.scenes import Camera

__all__ = ["Camera", "RenderError", "Renderer", "View", "fit_camera"]


def __getattr__(name: str) -> Any:
    """Import the renderer on first access; everything else works without PyVista."""
    if name != "Renderer":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require_graphics()
    from plab.render.renderer import Renderer

    return Renderer
