"""A page that plays a rollout in 3-D: ``plab view``, and :func:`plab.view.show` in a notebook.

K3D-jupyter, which draws with three.js, is optional: ``pip install 'plab[view]'``. docs/rendering.md has the
details.
"""

from plab.view.inline import Viewer, show

__all__ = ["Viewer", "show"]
