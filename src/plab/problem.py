"""Problems: scenes, targets, simulator and objective of a batch of configurations.

Runners and environments start here. All configurations of a batch must have the same kind of scene (numbers
of particles and manipulators, grid), as variants of one task do.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from plab.config import Config, ConfigError, build_scene, drawn_configs
from plab.config.compose import require_configs
from plab.config.selection import OBSERVATION_KEYS, leaves
from plab.losses import make_terms
from plab.objective import (
    Scores,
    batch_scores,
    score_scale,
    scores_from_iou,
    soft_iou,
    spread_mass,
    target_sdf,
    total_loss,
)
from plab.plugins import torch
from plab.scenes import Scene, SceneError
from plab.sim import SimulationError, Simulator
from plab.sim.tensors import Constants
from plab.targets import TargetError, build_targets, check_target, load_release_target

FIRST_SCENE = 1000
"""``seed_scene`` of the first random scene of ``method.scenes`` and of ``task.randomize.scenes``."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Episodes:
    """Result of a rollout of all environments, step by step, as arrays or, like the actions, CUDA tensors.

    Attributes:
        term_names: Names of the terms of the loss.
        terms: The terms after each step, unweighted, shape [batch, T, term].
        loss: Weighted step losses, shape [batch, T].
        reward: Rewards, shape [batch, T].
        iou: Soft IoU with the target after each step, shape [batch, T].
        final_mass: Mass tensors of the last states, shape [batch, n, n, n], or None.
        scores: Scores of each environment.
        gradient: Gradient of the sum of the step losses, shape [batch, T, A], or None.
        failures: Diverged environments, with time and reason; their values are meaningless.
    """

    term_names: tuple[str, ...]
    terms: np.ndarray
    loss: np.ndarray
    reward: np.ndarray
    iou: np.ndarray
    final_mass: np.ndarray | None
    scores: list[Scores]
    gradient: np.ndarray | None
    failures: dict[int, str]


def build_scenes(cfgs: Sequence[Config]) -> list[Scene]:
    """Build the scene of each configuration, sharing one object between equal scenes; errors are those of
    :func:`plab.config.build_scene`."""
    kinds = kinds_of(cfgs)
    scenes = {kind: build_scene(cfgs[kinds.index(kind)]) for kind in dict.fromkeys(kinds)}
    return [scenes[kind] for kind in kinds]


def fits(cfg: Config) -> bool:
    """Return True if a scene and its target fit into the domain, which is smaller for coarse grids."""
    try:
        check_target(build_scene(cfg), cfg.task.target)
    except (SceneError, TargetError):
        return False
    return True


def drawn_scenes(cfg: Config, numbers: Iterable[int], first: int = FIRST_SCENE) -> list[Config]:
    """Return the configurations of a task's random scenes that fit the grid, by their numbers from ``first``,
    or all if none fits, because building them then raises their errors."""
    drawn = drawn_configs(cfg, [first + number for number in numbers])
    return [one for one in drawn if fits(one)] or drawn


def make_simulator(
    cfgs: Config | Sequence[Config], scenes: Sequence[Scene] | None = None, **options: Any
) -> Simulator:
    """Create a simulator from the scenes, loss terms, device, precision and memory budget of configurations.

    Args:
        cfgs: A configuration, or one per environment, with equal ``sim`` and loss.
        scenes: Scenes of the configurations, if already built.
        **options: Arguments of :class:`plab.sim.Simulator`, whose errors apply, that override the
            configuration's.

    Raises:
        ConfigError: If ``cfgs`` is something else, such as overrides.
    """
    cfgs = [cfgs] if isinstance(cfgs, Config) else cfgs
    require_configs(cfgs)
    sim, method = cfgs[0].sim, cfgs[0].method
    keys = ("precision", "device", "memory_mb", "deterministic")
    settings: dict[str, Any] = {key: getattr(sim, key) for key in keys}
    settings["terms"] = make_terms(method.loss_weights, method.loss_terms)
    return Simulator(build_scenes(cfgs) if scenes is None else scenes, **settings | options)


def kinds_of(cfgs: Sequence[Config]) -> list[str]:
    """Return strings that are equal for configurations of the same environment, which differ only in seed,
    files and learning."""
    texts: dict[int, str] = {}
    for cfg in cfgs:
        # A planner's batch repeats each configuration.
        if id(cfg) not in texts:
            sections = (asdict(part) for part in (cfg.task, cfg.protocol, cfg.sim, cfg.targets))
            loss = cfg.method.loss_weights, cfg.method.loss_terms
            texts[id(cfg)] = json.dumps([cfg.variant, cfg.seed_particles, *sections, *loss])
    return [texts[id(cfg)] for cfg in cfgs]


class Problem:
    """Scenes, targets and simulator of a batch of configurations.

    Attributes:
        scenes: One scene per environment.
        simulator: Simulator, in its initial state.
        term_names: Names of the loss terms with nonzero weight.
        weights: Their weights in losses and rewards, shape [term], also after ``simulator.set_weights``.
        labels: Labels with units, by column of results.
        target_mass: Mass tensors of the targets, shape [batch, n, n, n].
        initial_iou: Soft IoUs of the initial states with the targets, shape [batch].
        best_iou: Soft IoUs of the targets with themselves, shape [batch].
    """

    def __init__(self, cfgs: Sequence[Config], simulator: Simulator | None = None) -> None:
        """Build scenes, targets and simulator.

        Args:
            cfgs: One configuration per environment, with equal ``protocol``, ``sim``, ``targets`` and loss.
            simulator: Existing simulator with the same scenes and loss terms, if any.

        Raises:
            plab.config.ConfigError: If the configurations are incompatible.
            plab.targets.TargetError: If a target cannot be built; see also :func:`make_simulator`.
        """
        require_alike(cfgs)
        # Vectorised environments and seeds of a sweep often have equal scenes, which are built once.
        kinds = kinds_of(cfgs)
        first = {kind: kinds.index(kind) for kind in kinds}
        self.simulator = simulator or make_simulator(cfgs)
        self.scenes = self.simulator.scenes
        weights = cfgs[0].method.loss_weights
        self.term_names = tuple(term.name for term in self.simulator.terms)
        self.weights = np.array([weights[name] for name in self.term_names])
        self.labels = {f"loss_{term.name}": f"{term.label} [{term.unit}]" for term in self.simulator.terms}
        try:
            self.target_mass = make_targets([cfgs[first[kind]] for kind in kinds], self.simulator)
        except SimulationError as error:
            error.by_kind = {kinds[e]: SimulationError(why) for e, why in error.failures.items()}
            raise
        # Distances are computed once for equal targets.
        distances, errors = dict[str, np.ndarray](), dict[str, TargetError]()
        for kind, k in first.items():
            try:
                distances[kind] = target_distance(self.target_mass[k])
            except TargetError as error:
                errors[kind] = error
        for error in errors.values():
            error.by_kind = errors
            raise error
        self._distances: list[np.ndarray] | None = [distances[kind] for kind in kinds]
        self.simulator.set_target(self.target_mass, np.stack(self._distances))
        self.target_mass = self.simulator.target_mass
        self.simulator.set_weights({name: weights[name] for name in self.term_names})
        # Generating a target changes the contact model, loading it from the cache does not.
        self.simulator.set_contact("soft")
        self._held_weights = Constants(self.weights)
        self._relative_target: tuple[np.ndarray, Constants] | None = None
        self.refresh(kinds)
        blind = {
            f"{cfg.task.name}-v{cfg.variant}: the score is only 0 or 1, because the start's soft IoU with "
            f"the target, {start:.4f}, is not below the target's own, {best:.4f}: "
            "use a finer grid, or a target that moves more mass"
            for cfg, start, best in zip(cfgs, self.initial_iou, self.best_iou, strict=True)
            if start >= best
        }
        for line in sorted(blind | _thin_manipulators(self.scenes)):
            _log.warning("%s", line)

    def refresh(self, kinds: Sequence[str] | None = None) -> None:
        """Reset the simulator, and update derived data after changes of its scenes, targets or initial
        states.

        Args:
            kinds: Strings that are equal for equal environments; default: all may differ.
        """
        self.simulator.reset()
        self.scenes, self._initial_mass = self.simulator.scenes, self.simulator.mass_tensor()
        self._stale_mass: set[int] = set()
        if self.target_mass is not self.simulator.target_mass:
            self.target_mass, self._distances = self.simulator.target_mass, None
        kinds = [str(k) for k in range(len(self.scenes))] if kinds is None else kinds
        pairs = zip(self._initial_mass, self.target_mass, strict=True)
        first = dict(zip(kinds, pairs, strict=True))
        ious = {k: (soft_iou(mass, goal), soft_iou(goal, goal)) for k, (mass, goal) in first.items()}
        self.initial_iou, self.best_iou = np.array([ious[kind] for kind in kinds]).T
        self._scale = Constants(score_scale(self.initial_iou, self.best_iou))

    def foreign_targets(self) -> dict[int, tuple[np.ndarray, None]]:
        """Return the targets that the caller has set in the simulator since :meth:`refresh`, by environment,
        as in :meth:`set_episode_starts`."""
        if self.simulator.target_mass is self.target_mass:
            return {}
        pairs = enumerate(zip(self.simulator.target_mass, self.target_mass, strict=True))
        return {e: (mass, None) for e, (mass, old) in pairs if not np.array_equal(mass, old)}

    def set_episode_starts(
        self,
        scenes: Sequence[Scene],
        particles: Mapping[int, np.ndarray],
        targets: Mapping[int, tuple[np.ndarray, np.ndarray | None]],
    ) -> None:
        """Set the initial states of the next episodes; call :meth:`note_starts` once they have started.

        Args:
            scenes: One scene per environment, of the same kind as before.
            particles: Changed initial positions by environment, [particle, 3] each.
            targets: Changed mass tensors and distances by environment, shape [n, n, n] each; None to compute
                the distance.

        Raises:
            plab.scenes.SceneError: If a scene cannot be simulated; nothing is changed then.
        """
        simulator = self.simulator
        simulator.change_scenes(scenes, particles)
        self.scenes = simulator.scenes
        self._stale_mass |= set(particles)
        if targets:
            distances = self.distances()
            for e, (mass, distance) in targets.items():
                distances[e] = target_distance(mass) if distance is None else distance
            simulator.change_targets({e: (mass, distances[e]) for e, (mass, _) in targets.items()})
            self.target_mass, self._distances = simulator.target_mass, distances
            for e in targets:
                self.best_iou[e] = soft_iou(self.target_mass[e], self.target_mass[e])

    def note_starts(self, environments: Sequence[int], iou: np.ndarray) -> None:
        """Set the soft IoUs of the initial states for scores, shape [batch]."""
        self.initial_iou[environments] = iou[environments]
        self._scale = Constants(score_scale(self.initial_iou, self.best_iou))

    def distances(self) -> list[np.ndarray]:
        """Return the distances to the targets, shape [n, n, n] each."""
        if self._distances is None:
            self._distances = [target_distance(mass) for mass in self.target_mass]
        return list(self._distances)

    @property
    def initial_mass(self) -> np.ndarray:
        """Mass tensors of the initial states, shape [batch, n, n, n]."""
        if self._stale_mass:
            x = self.simulator.initial_state().x
            for e in self._stale_mass:
                scene = self.scenes[e]
                spread = spread_mass(x[e], scene.grid_size, scene.particle_mass, scene.floor_stencil)
                self._initial_mass[e] = spread
            self._stale_mass = set()
        return self._initial_mass

    def loss_of(self, terms: Any) -> Any:
        """Return the weighted sum of terms, shape [..., term], as an array or tensor of shape [...]."""
        return total_loss(terms, self._held_weights.like(terms))

    def scores_of(self, iou: Any) -> tuple[Any, Any]:
        """Return ``score`` and ``score_printed``, shape [batch], given soft IoUs; arrays or tensors."""
        return batch_scores(self._scale.like(iou), iou)

    def totals(self, terms: Any, loss: Any, first_loss: Any, iou: Any) -> dict[str, float]:
        """Return the measures of a batch's first episode, as in the columns of results, given its terms after
        each step, shape [T, term], its step losses, shape [T], its initial loss, and the soft IoUs of the
        last states, shape [batch]; arrays or tensors."""
        sums = zip(self.term_names, terms.sum(0).tolist(), strict=True)
        return {
            "loss": float(loss.sum()),
            **{f"loss_{name}": total for name, total in sums},
            "reward": float((first_loss - loss).sum()),
            "iou": float(iou[0]),
            "score": float(self.scores_of(iou)[0][0]),
        }

    def batch_measures(self, episodes: Episodes) -> dict[str, Any]:
        """Return the measures of episodes, shape [batch] each: ``loss`` and its terms, ``reward``, ``iou``
        and ``score``, as in the columns of results, and ``final_loss``, the loss of the last step."""
        loss, iou = episodes.loss, episodes.iou[:, -1]
        # cumsum() adds in order, while the order of sum() depends on the number of episodes.
        tables = loss, episodes.terms, episodes.reward
        total, summed, reward = (values.cumsum(1)[:, -1] for values in tables)
        by_term = {f"loss_{name}": summed[:, k] for k, name in enumerate(self.term_names)}
        measures = {"loss": total, **by_term, "reward": reward, "iou": iou}
        return measures | {"score": self.scores_of(iou)[0], "final_loss": loss[:, -1]}

    def iou_gradient(self, actions: torch.Tensor) -> tuple[torch.Tensor, dict[int, str]]:
        """Return the gradient of the soft IoU of the last state with the target, shape [batch, T, A], for
        actions of that shape, and the diverged episodes with reasons; their gradient is 0."""
        failures, given = dict[int, str](), actions.clone()
        while True:
            given[list(failures)] = 0.0
            try:
                recorded = self.simulator.record(given if given.is_cuda else given.numpy(), every_step=False)
                mass = torch.as_tensor(recorded.mass).double().requires_grad_()
                a, b = mass / mass.amax((2, 3, 4), keepdim=True), self._target_like(mass)
                both = (a * b).sum((2, 3, 4))
                iou = both / ((a + b).sum((2, 3, 4)) - both)
                (slope,) = torch.autograd.grad(iou.sum(), mass)
                out = torch.as_tensor(recorded.pullback(mass=slope if given.is_cuda else slope.numpy()))
            except SimulationError as error:
                # An episode without actions may diverge, too.
                if failures.keys() >= error.failures.keys():
                    raise
                failures |= error.failures
                continue
            out[list(failures)] = 0.0
            return out, failures

    def _target_like(self, mass: torch.Tensor) -> torch.Tensor:
        """Return the targets' masses relative to the largest of each, shape [batch, 1, n, n, n], on the
        device of a tensor, to which they are copied once."""
        known = self._relative_target
        if known is None or known[0] is not self.target_mass:
            target = np.asarray(self.target_mass, np.float64)[:, None]
            known = self.target_mass, Constants(target / target.max((2, 3, 4), keepdims=True))
            self._relative_target = known
        return torch.as_tensor(known[1].like(mass))

    def rollout(
        self, actions: np.ndarray | torch.Tensor, *, gradient: bool, strict: bool = True, exact: bool = True
    ) -> Episodes:
        """Simulate actions from the initial states, in the simulator's current contact model.

        Args:
            actions: Actions, shape [batch, T, A]; clipped to [-1, 1].
            gradient: Whether to compute the gradient of the trajectory loss.
            strict: Whether divergence of an environment is an error instead of an entry in ``failures``.
            exact: Whether to copy the mass tensors of the last states to the host and compute scores from
                them, in float64. Otherwise scores use the simulator's IoU, which agrees to rounding and has
                no cost.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            plab.sim.SimulationError: If state, loss or gradient stop being finite and ``strict`` is set.
            MemoryError: If the gradient does not fit the memory budget.
        """
        result = self.simulator.rollout(actions, gradient=gradient, strict=strict)
        mass, ious = self.simulator.mass_tensor() if exact else None, result.step_iou[:, -1].tolist()
        for e, own in enumerate(() if mass is None else mass):
            if e not in result.failures:
                ious[e] = soft_iou(own, self.target_mass[e])
        loss = self.loss_of(result.step_terms)
        return Episodes(
            term_names=self.term_names,
            terms=result.step_terms,
            loss=loss,
            reward=self.loss_of(result.initial_terms)[:, None] - loss,
            iou=result.step_iou,
            final_mass=mass,
            scores=[self._score(e, iou) for e, iou in enumerate(ious)],
            gradient=result.gradient,
            failures=result.failures,
        )

    def scores(self, mass: np.ndarray) -> list[Scores]:
        """Score states by their mass tensors, shape [batch, n, n, n]."""
        return [self._score(e, soft_iou(own, self.target_mass[e])) for e, own in enumerate(mass)]

    def _score(self, e: int, iou: float) -> Scores:
        return scores_from_iou(float(self.initial_iou[e]), iou, float(self.best_iou[e]))


def _thin_manipulators(scenes: Sequence[Scene]) -> set[str]:
    """Return warnings of manipulators so thin that they fit between grid nodes, where contact is computed."""
    return {
        f"manipulators[{number}] is {2 * min(tool.size):.2g} thin, less than half a cell of the grid, "
        f"{scene.dx / 2:.2g}: it passes through bodies; use a finer grid"
        for scene in scenes
        for number, tool in enumerate(scene.manipulators)
        if 4 * min(tool.size) < scene.dx
    }


def target_distance(mass: np.ndarray) -> np.ndarray:
    """Return the distance to a target, shape [n, n, n]."""
    try:
        return target_sdf(mass)
    except ValueError as error:
        raise TargetError(f"{error}: raise sim.particles_scale or lower sim.grid_size") from None


def make_targets(cfgs: Sequence[Config], simulator: Simulator, *, rebuild: bool = False) -> np.ndarray:
    """Return the mass tensors of targets, shape [batch, n, n, n], from the release's files or from
    :func:`plab.targets.build_targets`.

    Args:
        cfgs: One configuration per environment; equal ones share one object.
        simulator: Simulator of their scenes.
        rebuild: Whether to simulate cached targets again.
    """
    source = cfgs[0].targets.source
    if source is None:
        return build_targets(simulator, [cfg.task.target for cfg in cfgs], rebuild=rebuild)
    pairs = zip(simulator.scenes, cfgs, strict=True)
    return np.stack([load_release_target(source, scene, cfg.variant) for scene, cfg in pairs])


def require_alike(cfgs: Sequence[Config]) -> None:
    """Raise ConfigError unless configurations can share a simulator and an observation space."""
    require_configs(cfgs)
    keys = ("protocol", "sim", "method.loss_weights", "method.loss_terms", "targets", *OBSERVATION_KEYS)
    parts = [dict(leaves({key: _plain(attrgetter(key)(cfg)) for key in keys})) for cfg in cfgs]
    for number, this in enumerate(parts):
        if differing := [key for key in parts[0] | this if parts[0].get(key) != this.get(key)]:
            raise ConfigError(f"{differing[0]} differs between environments 0 and {number} of one simulator")


def _plain(section: Any) -> Any:
    return getattr(section, "__dict__", section)
