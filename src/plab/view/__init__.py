"""3-D pages of rollouts: ``plab view``, and :func:`plab.view.show` in a notebook.

K3D-jupyter, which draws with three.js, is optional: ``pip install 'plab[view]'``. docs/rendering.md has the
details.
"""

from __future__ import annotations

import dataclasses
import html
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from plab.render.graphics import RenderError, require_packages

if TYPE_CHECKING:
    import numpy as np

    from plab.config import Config

_HEIGHT = 480


@dataclass(frozen=True)
class Viewer:
    """Rollout in 3-D, which notebooks display as the result of a cell.

    Attributes:
        page: HTML page, as written by ``plab view``.
        score: Score of the last state, NaN without a target.
        height: Height of the viewer in a notebook [pixels].
    """

    page: str = field(repr=False)
    score: float
    height: int = _HEIGHT

    def _repr_html_(self) -> str:
        """Return the page in a frame that isolates it from the notebook's styles and scripts."""
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe title="rollout in 3-D" style="{style}" srcdoc="{html.escape(self.page)}"></iframe>'


def show(
    what: str | PathLike[str] | Config,
    actions: np.ndarray | None = None,
    *,
    every: int | None = None,
    surface: bool = False,
    height: int = _HEIGHT,
) -> Viewer:
    """Simulate a rollout in the hard contact model, and return it for 3-D display in a notebook.

    If other simulators exist, it uses their device and precision, because Taichi supports only one of each at
    a time, and a change would invalidate them.

    Args:
        what: A result file, to replay its best actions; or a configuration.
        actions: Actions in [-1, 1] for the configuration, shape [T, A]; default: the best known actions for
            its task, or zeros.
        every: Environment steps between frames, interpolated by the viewer; default: at most 60
            frames.
        surface: Whether to show plasticine as smooth surfaces instead of particles.
        height: Height of the viewer [pixels].

    Raises:
        RenderError: If K3D-jupyter or PyVista is not installed, the file has no actions yet, actions are
            given for a file, or the actions do not fit the scene.
        plab.results.ResultsError: If the file cannot be read.
    """
    require_packages("the viewer needs", {"k3d": "K3D-jupyter", "pyvista": "PyVista"}, "view")
    # Imported here, because they load the simulator, which should not delay error messages.
    from plab.render import rollouts
    from plab.sim.runtime import in_use
    from plab.view.page import page

    if isinstance(what, str | PathLike):
        if actions is not None:
            raise RenderError("a result file has its own actions: pass actions only with a configuration")
        cfg, actions = rollouts.result(Path(what))
    else:
        cfg = what
        if actions is None:
            actions = rollouts.demonstration(cfg)
    if runtime := in_use():
        sim = dataclasses.replace(cfg.sim, device=runtime.device, precision=runtime.precision)
        cfg = dataclasses.replace(cfg, sim=sim)
    shown = rollouts.record(cfg, actions, motion=True)
    return Viewer(page(shown, every, surface=surface), shown.score, height)
