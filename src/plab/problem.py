"""A batch of configurations as one problem: scenes, targets, simulator, and what actions are judged by.

Runners and environments start here. All configurations of a batch share the kind of scene (numbers of
particles and manipulators, grid); variants of one task do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plab.config import ConfigError, build_scene, variant_task
from plab.objective import LossWeights, Scores, rewards, scores, target_sdf, total_loss
from plab.sim import Simulator
from plab.targets import TargetError, build_targets, load_release_target

if TYPE_CHECKING:
    from plab.config import Config
    from plab.scene import Scene

__all__ = ["Episodes", "Problem"]


@dataclass(frozen=True)
class Episodes:
    """What a rollout of all environments gave.

    Attributes:
        terms: Unweighted loss terms (density, SDF, contact) after each step, shape [batch, T, 3].
        loss: Weighted step losses, shape [batch, T].
        reward: Rewards, shape [batch, T].
        iou: Soft IoU with the target after each step, shape [batch, T].
        final_mass: Mass tensors of the last states, shape [batch, n, n, n].
        scores: How close each environment came.
        gradient: Gradient of the sum of the step losses, shape [batch, T, A], or None.
    """

    terms: np.ndarray
    loss: np.ndarray
    reward: np.ndarray
    iou: np.ndarray
    final_mass: np.ndarray
    scores: list[Scores]
    gradient: np.ndarray | None


class Problem:
    """Scenes, targets and simulator of a batch of configurations.

    Attributes:
        scenes: One scene per environment.
        simulator: Their simulator, in its initial state.
        weights: Weights of the loss terms.
        initial_mass: Mass tensors of the initial states, shape [batch, n, n, n].
        target_mass: Mass tensors of the targets, shape [batch, n, n, n].
    """

    def __init__(self, cfgs: Sequence[Config], simulator: Simulator | None = None) -> None:
        """Build everything.

        Args:
            cfgs: One configuration per environment, alike in ``sim``, ``method`` and ``targets``.
            simulator: Simulator of the very same scenes, if there is one already.

        Raises:
            plab.config.ConfigError: If the configurations do not fit together.
            plab.scene.SceneError: If a scene cannot be simulated or the scenes do not fit together.
            plab.targets.TargetError: If a target cannot be built.
            plab.sim.DeviceError: If CUDA was asked for and is not there.
        """
        _require_alike(cfgs)
        sim = cfgs[0].sim
        # Vectorised environments are many of one configuration: what is alike is made once.
        kinds = {id(cfg): cfg for cfg in cfgs}
        scenes = {key: build_scene(cfg) for key, cfg in kinds.items()}
        self.scenes: list[Scene] = [scenes[id(cfg)] for cfg in cfgs]
        self.weights: LossWeights = cfgs[0].method.loss_weights
        self.simulator = simulator or Simulator(
            self.scenes, precision=sim.precision, device=sim.device, memory_mb=sim.memory_mb
        )
        self.target_mass = _targets(cfgs, self.simulator)
        # Distances to equal targets are equal.
        distances = {key: _distance(self.target_mass[cfgs.index(cfg)]) for key, cfg in kinds.items()}
        self.simulator.set_target(self.target_mass, np.stack([distances[id(cfg)] for cfg in cfgs]))
        self.simulator.set_loss_weights(self.weights.density, self.weights.sdf, self.weights.contact)
        self.simulator.reset()
        self.initial_mass = self.simulator.mass_tensor()

    def rollout(self, actions: np.ndarray, *, gradient: bool) -> Episodes:
        """Run actions from the initial states, in the simulator's current contact model.

        Args:
            actions: Actions, shape [batch, T, A]; clipped to [-1, 1].
            gradient: Whether to compute the gradient of the trajectory loss.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            plab.sim.SimulationError: If state, loss or gradient stop being finite.
            MemoryError: If the gradient does not fit the memory budget.
        """
        result = self.simulator.rollout(actions, gradient=gradient)
        final_mass = self.simulator.mass_tensor()
        return Episodes(
            terms=result.step_terms,
            loss=total_loss(result.step_terms, self.weights),
            reward=rewards(result.initial_terms, result.step_terms, self.weights),
            iou=result.step_iou,
            final_mass=final_mass,
            scores=self.scores(final_mass),
            gradient=result.gradient,
        )

    def scores(self, mass: np.ndarray) -> list[Scores]:
        """Judge states by their mass tensors, shape [batch, n, n, n]."""
        return [
            scores(initial, final, target)
            for initial, final, target in zip(self.initial_mass, mass, self.target_mass, strict=True)
        ]


def _distance(mass: np.ndarray) -> np.ndarray:
    """Return the distance to a target, shape [n, n, n]."""
    try:
        return target_sdf(mass)
    except ValueError as error:
        raise TargetError(f"{error}: raise sim.particles_scale or lower sim.grid_size") from None


def _targets(cfgs: Sequence[Config], simulator: Simulator) -> np.ndarray:
    """Return the mass tensors of the targets, shape [batch, n, n, n], built or from the release's files."""
    source = cfgs[0].targets.source
    if source is None:
        targets = {id(cfg): variant_task(cfg).target for cfg in cfgs}
        return build_targets(simulator, [targets[id(cfg)] for cfg in cfgs])
    pairs = zip(simulator.scenes, cfgs, strict=True)
    return np.stack([load_release_target(source, scene, cfg.variant) for scene, cfg in pairs])


def _require_alike(cfgs: Sequence[Config]) -> None:
    """Refuse configurations of which one simulator could only follow the first."""
    for number, cfg in enumerate(cfgs):
        for part in ("sim", "method", "targets"):
            first, this = vars(getattr(cfgs[0], part)), vars(getattr(cfg, part))
            if differing := [f"{part}.{key}" for key in first if first[key] != this.get(key)]:
                raise ConfigError(
                    f"{differing[0]} differs between sub-environments 0 and {number}: "
                    f"they share one simulator"
                )
