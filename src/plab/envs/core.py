"""Batch of episodes in one simulator, the common basis of all environments.

The environments for Gymnasium, Stable-Baselines3 and PyTorch are thin adapters of an :class:`EpisodeBatch` to
the interface of each library.
"""

from __future__ import annotations

import copy
import functools
import inspect
import itertools
import json
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from gymnasium import logger
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded

from plab.config import Config, load_config, ranges
from plab.config.compose import require_configs
from plab.config.overrides import prepared
from plab.config.randomization import Values, with_own_materials
from plab.envs.observations import Array, Sensors, mapped, spaces
from plab.envs.randomization import EpisodeRandomizer
from plab.errors import ArgumentError, suggest
from plab.objective import earth_movers_distances
from plab.problem import Problem, build_scenes, make_simulator, require_alike
from plab.scenes import CONTACTS, Camera, is_whole
from plab.sim import SimulationError, Simulator, State
from plab.sim.tensors import Constants, on_device

if TYPE_CHECKING:
    import torch

    from plab.render import Renderer

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}
"""Gymnasium's metadata of every environment; at 20 frames per second an episode takes 2.5 s."""

_Method = TypeVar("_Method", bound=Callable[..., Any])

_LOCK = threading.RLock()
"""Held by the simulating thread, because Taichi compiles and launches kernels for one thread at a time."""


def _alone(method: _Method) -> _Method:
    """Serialise calls of a method from multiple threads."""

    @functools.wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        with _LOCK:
            return method(*args, **kwargs)

    return call  # type: ignore[return-value]


# -------------------------------------------------------------------------------------------------- arguments


@_alone
def make_batch(
    task: str,
    variant: str,
    *,
    num_envs: int = 1,
    overrides: Sequence[str] = (),
    overrides_per_env: Sequence[Sequence[str]] | None = None,
    max_episode_steps: int | None = None,
    config_dir: str | Path | None = None,
    **options: Any,
) -> EpisodeBatch:
    """Create the episodes of an environment.

    Args:
        task: Name of the task.
        variant: Name of the variant.
        num_envs: Number of sub-environments.
        overrides: Overrides for all of them, as on the command line: ``["sim.device=cuda"]``.
        overrides_per_env: Additional overrides, one list per sub-environment, such as ``[["variant=1"],
            ["variant=random", "seed_scene=5"]]``, except for ``sim`` and ``method``.
        max_episode_steps: Gymnasium's name of ``sim.horizon``.
        config_dir: Folder with the user's YAML files.
        **options: Keyword arguments of :class:`EpisodeBatch`, whose errors apply.

    Raises:
        ValueError: If an argument is unknown or does not fit, or an override sets the task.
        plab.config.ConfigError: If an override or a file is invalid.
    """
    known = {*inspect.signature(make_batch).parameters, *inspect.signature(EpisodeBatch).parameters}
    if unknown := sorted(set(options) - known):
        raise ArgumentError(
            f"environments have no argument '{unknown[0]}': keys of the configuration are overrides, such as "
            f"overrides=['sim.device=cuda']; {suggest(unknown[0], sorted(known - {'cfgs', 'options'}))}"
        )
    if not is_whole(num_envs) or isinstance(num_envs, bool):
        raise ArgumentError(f"num_envs must be a whole number of at least 1, not {num_envs!r}")
    own = [()] * num_envs if overrides_per_env is None else list(overrides_per_env)
    if len(own) != num_envs:
        raise ArgumentError(f"overrides_per_env has {len(own)} entries, but num_envs is {num_envs}")
    for entries in (overrides, *own):
        if own_task := [word for word in prepared(entries) if word.partition("=")[0] == "task"]:
            raise ArgumentError(f"'{own_task[0]}' has no effect on an environment of {task}: create another")
    steps = [] if max_episode_steps is None else [f"sim.horizon={max_episode_steps}"]
    lists = [(f"task={task}", f"variant={variant}", *overrides, *steps, *entries) for entries in own]
    made = {entries: load_config(entries, config_dir) for entries in dict.fromkeys(lists)}
    batch = EpisodeBatch([made[entries] for entries in lists], **{"stages": True} | options)
    # Sub-environments with different overrides have independent samples, too.
    batch._seeds = [(cfg.seed, e) for e, cfg in enumerate(batch.configs)]
    return batch


def check_render_mode(render_mode: str | None) -> str | None:
    """Return a valid render mode, or raise ValueError."""
    if render_mode is not None:
        ranges.one_of("render_mode", render_mode, METADATA["render_modes"])
    return render_mode


# --------------------------------------------------------------------------------------------------- episodes


@dataclass(frozen=True)
class Transition:
    """Result of one step of all sub-environments. The caller owns the arrays.

    Attributes:
        observation: Observations, shape [batch, entry], float32, or by key.
        reward: Rewards, shape [batch], float64; a tensor has the type of the actions.
        terminated: Whether episodes have ended in success, shape [batch], on the host.
        truncated: Whether episodes have reached the horizon, shape [batch], on the host.
        info: Entries of ``info``, each of shape [batch] and of the type of the rewards; sampled parameters
            are under ``randomized``, by key, on the host.
        failures: Environments that have diverged in the episode, with time and reason; they keep the values
            of the previous step. Empty if the step was ``strict``.
    """

    observation: Array
    reward: Array
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict[str, Any]
    failures: Mapping[int, str] = field(default_factory=dict)

    @property
    def cut_off(self) -> np.ndarray:
        """Mask of the episodes that have reached the horizon or diverged, shape [batch]."""
        broken = np.zeros_like(self.truncated)
        broken[list(self.failures)] = True
        return self.truncated | broken


@dataclass(frozen=True)
class EpisodeState:
    """State of a batch between two steps, see :meth:`EpisodeBatch.get_state`.

    Attributes:
        simulation: Particles and manipulators, shape [batch, ...] each.
        episodes: Attributes of the batch that belong to its episodes, by name.
        values: Sampled parameters and stage of each environment, by key.
        starts: Losses and soft IoUs of the initial states, shape [2, batch].
        changed_by_hand: The batch's ``changed_by_hand``.
    """

    simulation: State
    episodes: Mapping[str, Any]
    values: tuple[Values, ...]
    starts: np.ndarray
    changed_by_hand: int = 0


_EPISODES = ("_steps", "failures", "_last", "_seeds", "_episodes", "_over", "_earned", "_stage_scores")
"""Attributes of a batch that belong to its episodes."""


class EpisodeBatch:
    """Sub-environments simulated as one batch.

    Attributes:
        configs: One configuration per sub-environment.
        contact: Contact model of the episodes, ``hard`` or ``soft``.
        size: Number of sub-environments.
        horizon: Steps of an episode.
        randomizer: Randomisation and stages of the episodes.
        failures: Diverged environments, with time and reason.
        observation_space: Space of one sub-environment's observation.
        action_space: Space of one sub-environment's action.
        changed_by_hand: How often other scenes, materials, targets or initial states have been found in the
            simulator.
        listener: Called with the actions and the result of each step; None if nothing listens.
    """

    @_alone
    def __init__(
        self,
        cfgs: Sequence[Config],
        *,
        contact: str = "hard",
        observe: str | Sequence[str] = "state",
        cameras: Mapping[str, Camera | Mapping[str, Any]] | None = None,
        randomize: Mapping[str, Any] | None = None,
        impulses: bool = False,
        earth_movers: bool = False,
        stages: bool = False,
        success_score: float = 0.9,
        terminate_on_success: bool = False,
        render_size: tuple[int, int] = (480, 360),
        render_target: bool = False,
    ) -> None:
        """Build scenes, targets and simulator; the episodes start at :meth:`reset`.

        Args:
            cfgs: One configuration per sub-environment, with equal ``sim`` and loss.
            contact: Contact model, ``hard`` or ``soft``.
            observe: One of :data:`plab.envs.observations.OBSERVATIONS`, or several for dictionaries with
                keys such as ``state`` and ``front_depth``.
            cameras: Cameras by name, or their attributes; default: the task's, or one named ``front``.
            randomize: Ranges of randomised parameters, replacing those of the tasks, see
                :mod:`plab.config.randomization`; empty: none.
            impulses: Whether ``info`` contains the impulses on the manipulators; always if they are observed.
            earth_movers: Whether ``info`` contains the earth mover's distances of episodes at their ends, see
                :func:`plab.objective.earth_movers_distances`.
            stages: Whether episodes begin with the targets of ``task.stages``; set by :func:`make_batch`.
            success_score: Minimum score of a success.
            terminate_on_success: Whether a success ends the episode.
            render_size: Width and height of pictures [pixels].
            render_target: Whether pictures show the target as a translucent shape.

        Raises:
            ValueError: If the contact model or an observation does not exist, or ``render_size`` is invalid.
            plab.config.ConfigError: If the configurations are incompatible, or a range is invalid.
            plab.scenes.SceneError: If a scene cannot be simulated or the scenes cannot share a simulator.
            plab.targets.TargetError: If a target cannot be built.
            plab.sim.DeviceError: If CUDA is not available.
            RuntimeError: If this process was forked from one with environments.
        """
        ranges.one_of("contact", contact, CONTACTS)
        if np.shape(render_size) != (2,) or not all(map(is_whole, render_size)):
            raise ValueError(f"render_size must be a width and a height in pixels, not {render_size}")
        self._randomize, self._success_score = randomize, success_score
        self.terminates, self._goes_by_stages = terminate_on_success, stages
        cfgs = self._ranged(cfgs)
        self._sums_impulses, self._transports = impulses or "impulses" in observe, earth_movers
        problem = Problem(cfgs, make_simulator(cfgs, impulses=self._sums_impulses))
        self.contact, self.size, self.horizon = contact, len(cfgs), cfgs[0].sim.horizon
        self._picture_size, self._picture_target = render_size, render_target
        self._renderers: list[Renderer] = []
        self.listener: Callable[[Array, Transition], None] | None = None
        self._take(cfgs, problem)
        state_space, self.action_space = spaces(cfgs[0], [*self.problem.scenes, *self.randomizer.scenes])
        cameras = (cfgs[0].task.cameras or None) if cameras is None else cameras
        self._sensors = Sensors(observe, cameras, problem.simulator, state_space, cfgs[0])
        self.observation_space = self._sensors.space
        self._begin()

    @_alone
    def renew(self, cfgs: Sequence[Config]) -> None:
        """Replace the sub-environments by others of the same kind, without recompilation; the episodes start
        at :meth:`reset`.

        ``cfgs`` and errors are as in the constructor; the number of sub-environments must not change.
        """
        if len(cfgs) != self.size:
            raise ArgumentError(f"{len(cfgs)} configurations for {self.size} sub-environments")
        require_alike([*self.configs[:1], *cfgs])
        cfgs = self._ranged(cfgs)
        self._simulator.set_scenes(build_scenes(cfgs))
        self._take(cfgs, Problem(cfgs, self._simulator))
        self._begin()

    def _ranged(self, cfgs: Sequence[Config]) -> list[Config]:
        """Return configurations, sharing one object between equal ones, and their ranges."""
        require_configs(cfgs)
        given = list({id(cfg): cfg for cfg in cfgs}.values())
        first = {id(cfg): given[given.index(cfg)] for cfg in given}
        unique = {id(cfg): cfg for cfg in first.values()}
        for key, cfg in unique.items():
            if self._randomize is not None:
                # Arrays and their numbers become lists and numbers.
                text = json.dumps(self._randomize, default=lambda array: array.tolist())
                cfg = replace(cfg, task=replace(cfg.task, randomize=json.loads(text)))
                cfg.check()
            unique[key] = with_own_materials(cfg)
        return [unique[id(first[id(cfg)])] for cfg in cfgs]

    def _take(self, cfgs: Sequence[Config], problem: Problem) -> None:
        self._problem: Problem | None = problem
        self.configs = tuple(cfgs)
        self.randomizer = EpisodeRandomizer(cfgs, problem, stages=self._goes_by_stages)
        problem.simulator.set_contact(self.contact, softness=[cfg.method.softness for cfg in cfgs])

    def _begin(self) -> None:
        """Observe the initial states before any episode has started."""
        self.changed_by_hand = 0
        stages = self.randomizer.last_stage
        # Sum of the rewards of completed stages, and score of each stage, 0 for future ones.
        self._earned, self._stage_scores = np.zeros(self.size), np.zeros((self.size, stages + 1))
        if stages:
            self.randomizer.enter_stages(dict.fromkeys(range(self.size), 0), self.problem)
            self.problem.refresh()
        # No step is left before the first reset.
        self._steps = np.full(self.size, self.horizon)
        self._over = np.zeros(self.size, bool)
        # Environments with the same configuration, one object, have independent samples.
        numbers = defaultdict[int, Iterator[int]](itertools.count)
        self._seeds = [(cfg.seed, next(numbers[id(cfg)])) for cfg in self.configs]
        self._episodes = np.full(self.size, -1)
        self._simulator.reset()
        self._observe_starts()

    def _observe_starts(self) -> None:
        """Measure and observe the current states of all environments as initial states."""
        self._refresh_views()
        self._changes = self._simulator.changes
        self.failures: dict[int, str] = {}
        # Observations and measures of the last step, kept for diverged environments.
        self._last: tuple[Array, ...] = (self._observe(), *self._measured())
        self._initial_loss = Constants(self.problem.loss_of(self._last[1]))

    @property
    def problem(self) -> Problem:
        """Scenes, targets and simulator of the batch; raises RuntimeError if the environment is closed."""
        if self._problem is None:
            raise RuntimeError("the environment is closed: create a new one")
        return self._problem

    @property
    def over(self) -> np.ndarray:
        """Mask of the ended episodes, which must be reset, shape [batch]."""
        over = self._over.copy()
        over[list(self.failures)] = True
        return over

    @property
    def _simulator(self) -> Simulator:
        return self.problem.simulator

    def _refresh_views(self) -> None:
        """Update observations and pictures after changes of scenes and targets."""
        self._close_renderers()
        # Changes by the caller invalidate the observations of random scenes.
        known = dict if self.changed_by_hand else self.randomizer.target_observations
        self._sensors.refresh(self.problem, known)

    def _follow_changes(self, *, keep: bool) -> None:
        """Begin again if the caller has changed scenes, targets or initial states; ``keep`` the episodes."""
        if self._simulator.changes != self._changes:
            state = self.get_state() if keep else None
            self.changed_by_hand += 1
            self.randomizer.follow(self.problem)
            self._begin_again(state)

    def _begin_again(self, state: EpisodeState | None) -> None:
        """Start with the current scenes and targets of the simulator; continue from a state, if any."""
        self.problem.refresh()
        self._observe_starts()
        if state is not None:
            self._simulator.set_state(state.simulation)
            self._put(state)
            self._update(self._observe(), self._measured(), kept=list(self.failures))

    def _put(self, state: EpisodeState) -> None:
        for name, value in copy.deepcopy(dict(state.episodes)).items():
            setattr(self, name, value)

    @_alone
    def reset(
        self,
        like: torch.Tensor | None = None,
        *,
        environments: Sequence[int] | np.ndarray | None = None,
        seeds: Sequence[int] | None = None,
        episode: int | np.ndarray | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episodes of all or some sub-environments.

        Args:
            like: If a CUDA tensor, results are CUDA tensors.
            environments: Numbers or mask of the sub-environments to reset; default: all.
            seeds: Seeds of these environments, which restart their random sequences; default: continue.
            episode: Number of the episode, or of each environment's, shape [environment], which determines
                the samples; default: the next.
            options: Values by dotted key of the task that replace samples, for all of these sub-environments
                or, with a first axis of the batch's length, one for each.

        Returns:
            Observations, shape [batch, entry], float32, or by key; and ``info``, entries of shape [batch].
            Other sub-environments keep the values of their last step.

        Raises:
            ValueError: If an option is invalid.
            RuntimeError: If the environment is closed or its simulator is invalid, as in all other methods.
        """
        self._follow_changes(keep=environments is not None)
        chosen = slice(None) if environments is None else list(_on_host(environments))
        rows = np.arange(self.size)[chosen].tolist()
        if seeds is not None:
            for e, seed in zip(rows, checked_seeds(seeds, len(rows)), strict=True):
                self._seeds[e], self._episodes[e] = (seed, 0), -1
        numbers = self._episodes[rows] + 1 if episode is None else np.full(len(rows), episode)
        entropy = {e: (*self._seeds[e], int(number)) for e, number in zip(rows, numbers, strict=True)}
        drawn = {e: self.randomizer.sample(e, own, options or {}) for e, own in entropy.items()}
        changed = self.randomizer.put(drawn, self.problem)
        self._episodes[rows] = numbers
        self._steps[rows], self._over[rows] = 0, False
        self._earned[rows], self._stage_scores[rows] = 0.0, 0.0
        self.failures = {e: text for e, text in self.failures.items() if e not in rows}
        self._simulator.reset(None if environments is None else rows)
        self._restart(rows, like, changed)
        return self._shown()

    def _restart(self, rows: Sequence[int], like: Array, changed: bool) -> None:
        """Measure and observe the current states of some environments; if their scenes or targets have
        ``changed``, record them as initial states for scores and rewards."""
        measured = self._measured(like)
        if changed:
            terms, iou, _ = measured
            self._changes = self._simulator.changes
            self.problem.note_starts(rows, _on_host(iou))
            loss = self._initial_loss.like(None).copy()
            loss[rows] = _on_host(self.problem.loss_of(terms))[rows]
            self._initial_loss = Constants(loss)
            self._refresh_views()
        others = [e for e in range(self.size) if e not in rows]
        self._update(self._observe(like), measured, kept=others)

    def _update(self, observation: Any, measured: tuple[Array, ...], kept: Sequence[int]) -> None:
        """Store observations and measures, as arrays or CUDA tensors, except for some environments."""
        before, self._last = self._last, (observation, *measured)
        for table, old in zip(self._last, before, strict=True) if kept else ():
            mapped(lambda new, known: _set_rows(new, kept, known[kept]), table, old)

    def require_running(
        self, idle: np.ndarray | bool = False, *, steps: int = 1, frozen: bool = False
    ) -> None:
        """Raise ResetNeeded if an episode has fewer steps left or, unless ``frozen``, has diverged, except
        ``idle`` ones."""
        _ = self.problem  # raises RuntimeError if the environment is closed
        over = self._over | (self._steps + steps > self.horizon) | (not frozen and self.over)
        if np.any(over & ~np.asarray(idle)):
            raise ResetNeeded("the episode is over or has not started: call reset() before step()")

    @_alone
    def step(self, actions: Array, *, strict: bool = True, idle: np.ndarray | bool = False) -> Transition:
        """Advance all sub-environments by one step.

        Args:
            actions: Actions, shape [batch, action]; clipped to [-1, 1]. For a CUDA tensor, results are
                tensors on the same device, without copies to the host.
            strict: Whether divergence of a sub-environment is an error. Otherwise it is listed in
                ``failures`` and keeps its last values while the others continue, until :meth:`reset`. The
                value must not change within an episode.
            idle: Mask of ended sub-environments that will be reset, shape [batch]; their values are
                meaningless.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            gymnasium.error.ResetNeeded: If no episode has been started, or an episode has ended.
            plab.sim.SimulationError: If a simulation diverges and ``strict`` is True.
        """
        simulator = self._simulator
        self.require_running(idle, frozen=True)
        # The measures report divergence, too; checking here would wait for the device twice.
        simulator.step(actions, check=False)
        self._steps = self._steps + 1
        # Queued before the wait for the measures.
        observation = self._observe(actions)
        try:
            measured = self._measured(actions)
        except SimulationError as error:
            if strict:
                raise
            # Raised once per step; the second call returns the measures of the others.
            self.failures, measured = error.failures | self.failures, self._measured(actions)
        self._update(observation, measured, kept=list(self.failures))
        observation, info = self._shown()
        reward = self._initial_loss.like(actions) - info["loss"]
        terminated = _on_host(info["success"]).copy() if self.terminates else np.zeros(self.size, bool)
        truncated = self._steps == self.horizon
        self._over = terminated | truncated
        ended = np.flatnonzero(self._over & ~np.asarray(idle))
        if self._transports and (rows := np.setdiff1d(ended, list(self.failures))).size:
            self._note_ends(rows, info)
        if self.randomizer.last_stage:
            reward = self._go_on(reward, info, actions)
            observation = mapped(_copy, self._last[0])
        done = Transition(observation, reward, terminated, truncated, info, dict(self.failures))
        if self.listener is not None:
            self.listener(actions, done)
        return done

    def _go_on(self, reward: Array, info: dict[str, Any], like: Array) -> Array:
        """Advance environments that have reached their stage's target; return the rewards."""
        reward = reward + Constants(self._earned.copy()).like(like)
        score, stages = _on_host(info["score"]), self.randomizer.stages
        self._stage_scores[np.arange(self.size), stages] = score
        reached = (score >= self._success_score) & (stages < self.randomizer.last_stage)
        reached[list(self.failures)] = False
        rows = np.flatnonzero(reached).tolist()
        if rows:
            self._earned[rows] = _on_host(reward)[rows]
            self.randomizer.enter_stages({e: int(stages[e]) + 1 for e in rows}, self.problem)
            self._restart(rows, like, changed=True)
        info |= self._stage_info(info["score"])
        return reward

    def _stage_info(self, like: Array) -> dict[str, Any]:
        """Return the number of each environment's stage, and the score reached in each stage."""
        if not self.randomizer.last_stage:
            return {}
        known = {"stage": self.randomizer.stages, "stage_scores": self._stage_scores}
        device = on_device(like)
        return {key: like.new_tensor(value) if device else value.copy() for key, value in known.items()}

    @_alone
    def get_state(self) -> EpisodeState:
        """Return a copy of the state for :meth:`set_state`, bitwise reproducible on the CPU."""
        simulation = self._simulator.state()
        for e in self.failures:
            # Diverged environments are frozen in an arbitrary finite state.
            simulation.x[e], simulation.v[e], simulation.C[e], simulation.F[e] = 0.5, 0.0, 0.0, np.eye(3)
        starts = self._initial_loss.like(None), self.problem.initial_iou
        episodes = {name: copy.deepcopy(getattr(self, name)) for name in _EPISODES}
        values = tuple(self.randomizer.values)
        return EpisodeState(simulation, episodes, values, np.array(starts), self.changed_by_hand)

    @_alone
    def set_state(self, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
        """Restore a state returned by :meth:`get_state` of a batch of the same kind; return its observations
        and ``info``. Raise ValueError if a shape is wrong.

        After changes of the simulator's scenes, materials, targets or initial states, losses and scores are
        computed with the current targets, which are also the observed ones."""
        self._simulator.set_state(state.simulation)
        self._follow_changes(keep=False)
        changed = self.randomizer.put(dict(enumerate(state.values)), self.problem)
        if state.changed_by_hand != self.changed_by_hand:
            self._begin_again(state)
            return self._shown()
        if changed or self.randomizer.last_stage:
            self._changes = self._simulator.changes
            self.problem.note_starts(range(self.size), state.starts[1])
            self._initial_loss = Constants(state.starts[0])
            self._refresh_views()
        self._put(state)
        return self._shown()

    def _shown(self) -> tuple[Any, dict[str, Any]]:
        """Return copies of the last observations, and ``info``."""
        observation, *measured = (mapped(_copy, table) for table in self._last)
        return observation, self._info(*measured)

    @_alone
    def closed_loop(
        self,
        steps: int,
        choose: Callable[[int, Array], Array],
        react: Callable[[int, Array], Array | None],
        *,
        discount: float = 1.0,
        like: torch.Tensor | None = None,
    ) -> Array:
        """Advance all sub-environments by some steps with actions chosen from observations, and backpropagate
        through the states and the policy: :meth:`plab.sim.Simulator.closed_loop` with observations, shape
        [batch, entry], float64 or of the type of ``like``, in place of states.

        Raises:
            gymnasium.error.ResetNeeded: If the episodes have fewer steps left; other errors are those of the
                simulator.
        """
        self.require_running(steps=steps, frozen=True)
        taken, sensors = self._steps, self._sensors

        def chosen(t: int, particles: Array, poses: Array) -> Array:
            seen = sensors.state(particles, poses)
            return choose(t, self._noisy(seen, taken + t))

        def reaction(t: int, actions_bar: Array) -> tuple[Array, Array] | None:
            bar = react(t, actions_bar)
            return None if bar is None else sensors.pull_back(bar)

        terms = self._simulator.closed_loop(
            steps, chosen, reaction, stride=sensors.stride, discount=discount, like=like
        )
        self._steps = taken + steps
        self._update(self._observe(like), self._measured(like), kept=list(self.failures))
        return terms

    @_alone
    def frames(self) -> tuple[np.ndarray, ...]:
        """Return a picture of each sub-environment's current state, shape [height, width, 3], uint8."""
        simulator = self._simulator
        if not self._renderers:
            # Imported here, because rendering is optional and its library takes a second to load.
            from plab.render import Renderer

            for scene, mass in zip(self.problem.scenes, self.problem.target_mass, strict=True):
                target = mass if self._picture_target else None
                self._renderers.append(Renderer(scene, target, self._picture_size))
        x, poses = simulator.observe(1)[..., :3], simulator.poses()
        return tuple(r.frame(x[e], poses[e]) for e, r in enumerate(self._renderers))

    def close(self) -> None:
        """Release the simulator and the renderers; closing twice is allowed."""
        self._close_renderers()
        self._problem = None
        self._sensors.release()

    def _close_renderers(self) -> None:
        for renderer in self._renderers:
            renderer.close()
        self._renderers = []

    def _observe(self, like: Array = None) -> Any:
        return self._noisy(self._sensors(like), self._steps)

    def _noisy(self, observation: Any, steps: np.ndarray) -> Any:
        """Add the sampled noise to observations."""
        if not (deviations := self.randomizer.noise()).any():
            return observation
        rngs = [
            np.random.default_rng([*seed, int(episode), int(step), 1])
            for seed, episode, step in zip(self._seeds, self._episodes, steps, strict=True)
        ]
        return self._sensors.noisy(observation, deviations, rngs)

    def _measured(self, like: Array = None) -> tuple[Array, ...]:
        """Return loss terms, IoU and, by name, requested measures of the current states."""
        measures = self._simulator.measure(like)
        requested = {"impulses": self._simulator.impulses(like)} if self._sums_impulses else {}
        if self._transports:
            requested["earth_movers"] = measures.iou * np.nan
        return measures.terms, measures.iou, requested

    def _note_ends(self, rows: np.ndarray, info: Mapping[str, Any]) -> None:
        """Add the earth mover's distances of the current states of some environments to ``info``."""
        import torch

        masses = self._simulator.mass_tensor()[rows], self.problem.target_mass[rows]
        distances = earth_movers_distances(*masses, torch.empty(0, device=self._simulator.device))
        for table in (info["earth_movers"], self._last[-1]["earth_movers"]):
            _set_rows(table, rows, distances)

    def _info(self, terms: Array, iou: Array, requested: Mapping[str, Array]) -> dict[str, Any]:
        score, printed = self.problem.scores_of(iou)
        drawn, success = self.randomizer.info(), score >= self._success_score
        if last := self.randomizer.last_stage:
            success = success & (Constants(self.randomizer.stages == last).like(iou) > 0.0)
        return {
            "loss": self.problem.loss_of(terms),
            **{f"loss_{name}": terms[:, k] for k, name in enumerate(self.problem.term_names)},
            "iou": iou,
            "score": score,
            "score_printed": printed,
            "success": success,
            **self._stage_info(iou),
            **requested,
            **({"randomized": drawn} if drawn else {}),
        }


class Restorable:
    """Copying and pickling of environments, by their arguments and state.

    Attributes:
        batch: The episodes.
        render_mode: ``rgb_array``, or None for no pictures.
    """

    batch: EpisodeBatch
    render_mode: str | None
    _arguments: dict[str, Any]

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification; its ``max_episode_steps`` is ``sim.horizon``."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._spec = copy.copy(value)
        if self._spec is not None:
            self._spec.max_episode_steps = self.batch.horizon

    _spec: EnvSpec | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments, state and generators; raise TypeError if the simulator was changed."""
        batch = self.batch
        if batch.changed_by_hand or batch.problem.simulator.changes != batch._changes:
            raise TypeError(
                "an environment whose simulator was changed (set_scenes, set_material, set_target or "
                "set_initial_state) cannot be copied"
            )
        return {
            "arguments": self._arguments,
            "state": self.batch.get_state(),
            "spec": self.spec,
            "random": (getattr(self, "_np_random", None), getattr(self, "_np_random_seed", None)),
        }

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Rebuild the environment, and restore the state."""
        self.__init__(**kept["arguments"])  # type: ignore[misc]
        self.batch.set_state(kept["state"])
        self.spec = kept["spec"]
        self._is_seeded = True
        self._np_random, self._np_random_seed = kept["random"]

    def _first_seeds(self, seed: int | Sequence[int] | None) -> Sequence[int] | None:
        """Return the randomisation seeds of the sub-environments, from ``np_random`` if no seed was given;
        None to continue the random sequences."""
        count = self.batch.size
        if seed is None and not self._is_seeded:
            seed = [int(one) for one in self.np_random.integers(2**31, size=count)]  # type: ignore[attr-defined]
        self._is_seeded = True
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + e for e in range(count)]
        return None if seed is None else checked_seeds(seed, count)

    _is_seeded = False

    def get_state(self) -> EpisodeState:
        """Return a copy of the state of the episodes; see :meth:`EpisodeBatch.get_state`."""
        return self.batch.get_state()

    def render(self) -> Any:
        """Return one picture per sub-environment, shape [height, width, 3], uint8; None unless
        ``render_mode`` is ``rgb_array``."""
        if self.render_mode is None:
            logger.warn('nothing to render: make the environment with render_mode="rgb_array"')
            return None
        return self.batch.frames()


def checked_seeds(seeds: Sequence[int], count: int) -> list[int]:
    """Return one seed per environment; raise ValueError if they are anything else."""
    numbers: Any = np.asarray(seeds).tolist()
    if np.shape(numbers) != (count,) or not all(is_whole(number, 0) for number in numbers):
        raise ArgumentError(f"seeds must be {count} whole numbers of at least 0, not {seeds}")
    return list(numbers)


def _set_rows(table: Array, rows: Sequence[int] | np.ndarray, values: Array) -> None:
    if on_device(table):
        table[rows] = values.to(table) if on_device(values) else table.new_tensor(values)
    else:
        table[rows] = _on_host(values)


def _copy(table: Array) -> Array:
    return table.clone() if on_device(table) else table.copy()


def _on_host(table: Array) -> np.ndarray:
    return table.cpu().numpy() if on_device(table) else np.asarray(table)


def info_of(transition_info: Mapping[str, Any], e: int, failures: Mapping[int, str]) -> dict[str, Any]:
    """Return the ``info`` of one sub-environment, with the reason as ``failure`` if it has diverged."""

    def one(values: np.ndarray) -> Any:
        return values[e].item() if values.ndim == 1 else values[e]

    info = {name: mapped(one, values) for name, values in transition_info.items()}
    return info | ({"failure": failures[e]} if e in failures else {})
