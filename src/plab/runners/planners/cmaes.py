"""``cmaes``, covariance matrix adaptation of a curve's points, by the library cmaes.

To reproduce a result:

    python -m plab.run task=Move variant=1 method=cmaes seed=0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.runners.libraries import torch
from plab.runners.planners.planner import Sampler, SamplerConfig

if TYPE_CHECKING:
    from cmaes import CMA
    from torch import Tensor

__all__ = ["Cmaes", "CmaesConfig"]


@dataclass
class CmaesConfig(SamplerConfig):
    """Covariance matrix adaptation."""


class Cmaes(Sampler):
    """The points of a curve, end to end, are what the library searches over, on the host: tens of numbers."""

    method: CmaesConfig
    _search: CMA

    def settle(self, point: Tensor) -> None:
        """Begin to draw around a curve."""
        from cmaes import CMA

        flat = point.flatten().cpu().numpy()
        bounds = np.stack([-np.ones_like(flat), np.ones_like(flat)], axis=1)
        # Not drawn again where it leaves the bounds, but clipped: in many dimensions nearly all would.
        self._search = CMA(
            flat,
            self.method.spread,
            bounds=bounds,
            n_max_resampling=0,
            population_size=self.method.population,
        )

    def sample(self, random: torch.Generator) -> Tensor:
        """Draw with the library's own generator, from a seed of the iteration's."""
        self._search.reseed_rng(int(torch.randint(2**31, (1,), generator=random, device=self.start.device)))
        drawn = np.stack([self._search.ask() for _ in range(self.method.population)])
        return torch.as_tensor(drawn, device=self.start.device).reshape(-1, self.knots, self.start.shape[1])

    def learn(self, points: Tensor, cost: Tensor) -> None:
        """Tell the library what each of them costs."""
        pairs = zip(points.flatten(1).cpu().numpy(), cost.tolist(), strict=True)
        self._search.tell(list(pairs))
        # What the library keeps of its covariance is one triangle: a run that goes on has to have just that.
        self._search.__setstate__(self._search.__getstate__())

    def state(self) -> dict[str, Any]:
        """Return everything that the next iterations depend on, that of the library included."""
        held = self._search.__getstate__()
        return super().state() | {"search": {name: v for name, v in held.items() if v is not None}}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`."""
        super().restore(state)
        self.settle(self.memory["best"])
        held = {name: np.asarray(value)[()] for name, value in state["search"].items()}
        self._search.__setstate__(self._search.__getstate__() | held)
