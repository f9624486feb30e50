"""Batch of episodes that start, advance and end together, below the environments of all libraries.

The environments for Gymnasium, Stable-Baselines3 and PyTorch are views of an :class:`EpisodeBatch` in the
form that each library asks for, and add nothing of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from gymnasium.error import ResetNeeded

from plab.config import Config, load_config
from plab.config.selection import OBSERVED
from plab.config.words import prepared
from plab.envs.observations import Observer, Sensors, mapped, spaces
from plab.errors import ArgumentError
from plab.problem import Problem, build_scenes, kinds_of
from plab.scenes import CONTACTS, Camera
from plab.sim import SimulationError, Simulator, State
from plab.sim.tensors import Constants, on_device

if TYPE_CHECKING:
    import torch

    from plab.render import Renderer

__all__ = [
    "METADATA",
    "PICTURE_SIZE",
    "EpisodeBatch",
    "EpisodeState",
    "Restorable",
    "Transition",
    "check_render_mode",
    "compose_configs",
    "refuse_options",
]

Array: TypeAlias = Any
"""A NumPy array, or a CUDA tensor where the caller gave one."""

PICTURE_SIZE = (480, 360)
"""Default width and height of pictures [pixels]."""

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}
"""Gymnasium's metadata of every environment; 20 frames a second show an episode in two and a half."""


# -------------------------------------------------------------------------------------------------- arguments


def compose_configs(
    task: str,
    variant: str,
    *,
    num_envs: int = 1,
    overrides: Sequence[str] = (),
    overrides_per_env: Sequence[Sequence[str]] | None = None,
    config_dir: str | Path | None = None,
) -> list[Config]:
    """Compose one configuration per sub-environment.

    Args:
        task: Name of the task.
        variant: Name of its variant.
        num_envs: Number of sub-environments.
        overrides: Overrides for all of them, as on the command line.
        overrides_per_env: Further overrides, one list per sub-environment.
        config_dir: Folder with YAML files of the user's own.

    Returns:
        The checked configurations.

    Raises:
        ValueError: If the numbers do not fit, or overrides are no lists or name a task.
        plab.config.ConfigError: If an override or a file does not fit.
    """
    if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
        raise ArgumentError(f"num_envs must be a whole number of at least 1, not {num_envs!r}")
    own = [()] * num_envs if overrides_per_env is None else list(overrides_per_env)
    if len(own) != num_envs:
        raise ArgumentError(f"overrides_per_env has {len(own)} entries, but num_envs is {num_envs}")
    for entries in (overrides, *own):
        if own_task := [word for word in prepared(entries) if word.partition("=")[0] == "task"]:
            raise ArgumentError(
                f"'{own_task[0]}' in an environment of task {task}: make that task's environment"
            )
    lists = [(f"task={task}", f"variant={variant}", *overrides, *entries) for entries in own]
    made = {entries: load_config(entries, config_dir) for entries in dict.fromkeys(lists)}
    return [made[entries] for entries in lists]


def refuse_options(options: Mapping[str, Any] | None) -> None:
    """Raise ValueError if ``reset`` was given an option: there are none."""
    if options:
        raise ArgumentError(f"unknown reset option '{next(iter(options))}': plab's environments have none")


def check_render_mode(render_mode: str | None) -> str | None:
    """Return a render mode; ValueError if there is none of this name."""
    modes = METADATA["render_modes"]
    if render_mode is not None and render_mode not in modes:
        raise ArgumentError(f"render_mode '{render_mode}' is not one of {', '.join(modes)}")
    return render_mode


# --------------------------------------------------------------------------------------------------- episodes


@dataclass(frozen=True)
class Transition:
    """Result of one step of all sub-environments. The arrays are the caller's.

    Attributes:
        observation: Observations, shape [batch, entry], float32, or by key.
        reward: Rewards, shape [batch], float64; a tensor has the type of the actions.
        truncated: Whether the episodes are over.
        info: The entries of ``info``, each of shape [batch], in type like the rewards.
        failures: Environments that have broken off in the episode, with time and reason; their numbers are
            those of the step before. Empty if the step was ``strict``.
    """

    observation: Array
    reward: Array
    truncated: bool
    info: dict[str, Array]
    failures: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class EpisodeState:
    """State of a batch between two steps, see :meth:`EpisodeBatch.get_state`.

    Attributes:
        step: Steps taken in the episodes; None before the first :meth:`EpisodeBatch.reset`.
        simulation: Particles and manipulators, shape [batch, ...] each.
        failures: Environments that have broken off.
        last: Observations, loss terms and IoU of the last step that was not ``strict``.
    """

    step: int | None
    simulation: State
    failures: Mapping[int, str]
    last: tuple[Any, ...]


class EpisodeBatch:
    """Sub-environments in one simulator, all in the same step of their episodes.

    Attributes:
        configs: One configuration per sub-environment.
        contact: Contact model of the episodes, ``hard`` or ``soft``.
        size: Number of sub-environments.
        horizon: Steps of an episode.
        observation_space: Space of one sub-environment's observation.
        action_space: Space of one sub-environment's action.
        picture_size: Width and height of pictures [pixels], to be set before the first.
        picture_target: Whether pictures show the target, as a ghost; likewise.
        listener: Called with the actions and the result of each step; None if nothing listens.
    """

    def __init__(
        self,
        cfgs: Sequence[Config],
        *,
        contact: str = "hard",
        observe: str | Sequence[str] = "state",
        cameras: Mapping[str, Camera | Mapping[str, Any]] | None = None,
    ) -> None:
        """Build everything; the episodes start at :meth:`reset`.

        Args:
            cfgs: One configuration per sub-environment, alike in ``sim`` and the loss.
            contact: Contact model, ``hard`` or ``soft``.
            observe: One of ``state``, ``particles``, ``depth``, ``rgb`` and ``segmentation``; or several,
                which makes observations a dictionary with keys such as ``state`` and ``front_depth``.
            cameras: Cameras of pictures by name, or their attributes; one named ``front`` if None.

        Raises:
            ValueError: If the contact model or an observation does not exist.
            plab.config.ConfigError: If the configurations do not fit together.
            plab.scenes.SceneError: If a scene cannot be simulated or the scenes do not fit together.
            plab.targets.TargetError: If a target cannot be built.
            plab.sim.DeviceError: If CUDA was asked for and is not there.
            RuntimeError: If this process was forked from one that has made environments.
        """
        if contact not in CONTACTS:
            raise ArgumentError(f"contact '{contact}' is not one of {', '.join(CONTACTS)}")
        _require_alike(cfgs)
        problem = Problem(cfgs)
        self.contact, self.size, self.horizon = contact, len(cfgs), cfgs[0].sim.horizon
        self.picture_size, self.picture_target = PICTURE_SIZE, False
        self._renderers: list[Renderer] = []
        self.listener: Callable[[Array, Transition], None] | None = None
        self._take(cfgs, problem)
        state_space, self.action_space = spaces(cfgs[0], self.problem.scenes)
        self._sensors = Sensors(observe, cameras, problem.simulator, state_space)
        self.observation_space = self._sensors.space
        self._begin()

    def renew(self, cfgs: Sequence[Config]) -> None:
        """Replace the sub-environments by others of the same kind, without compiling; the episodes start at
        :meth:`reset`.

        Args:
            cfgs: One configuration per sub-environment, alike in ``sim`` and the loss.

        Raises:
            ValueError: If they are not as many, or observations would hold other things.
            plab.config.ConfigError: If the configurations do not fit together.
            plab.scenes.SceneError: If a scene cannot be simulated or is of another kind.
            plab.targets.TargetError: If a target cannot be built.
        """
        if len(cfgs) != self.size:
            raise ArgumentError(f"{len(cfgs)} configurations for {self.size} sub-environments")
        _require_alike([*self.configs[:1], *cfgs])
        scenes, simulator, problem = build_scenes(cfgs), self._simulator, self.problem
        simulator.reset()
        if kinds_of(cfgs) != kinds_of(self.configs):
            # After an error half way, the batch belongs to no configurations.
            self.configs: tuple[Config, ...] = ()
            simulator.set_scenes(scenes)
            problem = Problem(cfgs, simulator)
        self._take(cfgs, problem)
        self._sensors.refresh()
        self._begin()

    def _take(self, cfgs: Sequence[Config], problem: Problem) -> None:
        self._close_renderers()
        self._problem: Problem | None = problem
        self.configs = tuple(cfgs)
        self._observer = Observer(problem, cfgs[0])
        problem.simulator.set_contact(self.contact, softness=[cfg.method.softness for cfg in cfgs])

    def _begin(self) -> None:
        """Observe the initial states; no episode has started."""
        self._step: int | None = None
        self._changes = self._simulator.changes
        self._failures: dict[int, str] = {}
        # Observations, loss terms and IoU of the last step, which environments that break off keep.
        self._initial = self._last = self._seen()
        self._initial_loss = Constants(self._info(*self._initial[1:])["loss"])

    @property
    def problem(self) -> Problem:
        """Scenes, targets and simulator of the sub-environments.

        Raises:
            RuntimeError: If the environment is closed.
        """
        if self._problem is None:
            raise RuntimeError("the environment is closed: make a new one")
        return self._problem

    @property
    def _simulator(self) -> Simulator:
        return self.problem.simulator

    def reset(self, like: torch.Tensor | None = None) -> tuple[Any, dict[str, Any]]:
        """Put all sub-environments into their initial states.

        Args:
            like: Given a CUDA tensor, everything returned is one too.

        Returns:
            Observations, shape [batch, entry], float32, or by key; and ``info``, each of shape [batch].

        Raises:
            RuntimeError: If the environment is closed or its simulator's memory is gone.
        """
        if self._simulator.changes != self._changes:
            # The caller has changed scenes, targets or initial states.
            self.problem.refresh()
            self._observer = Observer(self.problem, self.configs[0])
            self._sensors.refresh()
            self._begin()
        self._simulator.reset()
        self._step, self._failures = 0, {}
        self._last = self._seen(like) if on_device(like) else self._initial
        # Copies: a caller may keep and change what it is given.
        observation, terms, iou = _copies(self._last)
        return observation, self._info(terms, iou)

    def step(self, actions: Array, *, strict: bool = True) -> Transition:
        """Advance all sub-environments by one step.

        Args:
            actions: Actions, shape [batch, action]; clipped to [-1, 1]. Given a CUDA tensor, what comes back
                are tensors on the same device, and no array crosses to the host.
            strict: Whether a sub-environment that breaks off is an error. Otherwise, the same for all steps
                of an episode, it is an entry in ``failures`` and keeps its last numbers while the others go
                on; :meth:`reset` restores it.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            gymnasium.error.ResetNeeded: If no episode has been started, or it is over.
            plab.sim.SimulationError: If a state stops being finite and ``strict`` is set.
            RuntimeError: If the environment is closed or its simulator's memory is gone.
        """
        simulator, now = self._simulator, self._now()
        # The measures report faults, too: checking here would wait for the device twice.
        simulator.step(actions, check=False)
        # Queued before the wait for the measures.
        observation = self._observe(actions)
        try:
            measures = simulator.measure(actions)
        except SimulationError as error:
            if strict:
                raise
            # Raised once a step: the second call returns the measures of the others.
            self._failures, measures = error.failures | self._failures, simulator.measure(actions)
        seen = observation, measures.terms, measures.iou
        if self._failures:
            for table, before in zip(seen, self._last, strict=True):
                mapped(lambda now, then: _restore_rows(now, then, list(self._failures)), table, before)
        if not strict:
            self._last = _copies(seen)
        self._step = now + 1
        info = self._info(*seen[1:])
        reward = self._initial_loss.like(actions) - info["loss"]
        result = Transition(observation, reward, self._step == self.horizon, info, dict(self._failures))
        if self.listener is not None:
            self.listener(actions, result)
        return result

    def get_state(self) -> EpisodeState:
        """Return a copy of the state, from which :meth:`set_state` continues: on the CPU with the same bits.

        Raises:
            RuntimeError: If the environment is closed or its simulator's memory is gone.
        """
        return EpisodeState(self._step, self._simulator.state(), dict(self._failures), _copies(self._last))

    def set_state(self, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
        """Replace the state by one that :meth:`get_state` of a batch of the same kind has returned.

        Returns:
            Observations and ``info`` of the state, as :meth:`reset` returns them.

        Raises:
            ValueError: If a shape is wrong.
            RuntimeError: If the environment is closed or its simulator's memory is gone.
        """
        self._simulator.set_state(state.simulation)
        self._step, self._failures, self._last = state.step, dict(state.failures), _copies(state.last)
        observation, terms, iou = self._seen()
        return observation, self._info(terms, iou)

    def closed_loop(
        self,
        steps: int,
        choose: Callable[[int, Array], Array],
        react: Callable[[int, Array], Array | None],
        *,
        discount: float = 1.0,
        like: torch.Tensor | None = None,
    ) -> Array:
        """Advance all sub-environments by some steps whose actions are chosen from observations, and go back
        through the states and through what chose the actions.

        Observations are float64; CUDA tensors have the type of ``like``.

        Args:
            steps: Steps T, at most those that are left of the episodes.
            choose: Called with t = 0 to T and observations, shape [batch, entry]; returns the actions of step
                t, shape [batch, action]; what it returns for T is ignored.
            react: Called with t = T to 0 and the derivative of the discounted loss by the actions of step t,
                None for T; returns the derivative by the observation before step t through these actions
                (for T: of a function of the last observation), or None.
            discount: The loss of step t weighs so much to the power of t.
            like: Given a CUDA tensor, everything is one too.

        Returns:
            Unweighted loss terms after each step, shape [batch, T, term].

        Raises:
            gymnasium.error.ResetNeeded: If the episodes have fewer steps left.
            plab.sim.SimulationError: If a state, loss or gradient stops being finite.
            MemoryError: If the gradient does not fit the memory budget.
        """
        now = self._now(steps)

        def chosen(t: int, particles: Array, poses: Array) -> Array:
            return choose(t, self._observer(particles, poses))

        def reaction(t: int, actions_bar: Array) -> tuple[Array, Array] | None:
            bar = react(t, actions_bar)
            return None if bar is None else self._observer.pull_back(bar)

        terms = self._simulator.closed_loop(
            steps, chosen, reaction, stride=self._observer.stride, discount=discount, like=like
        )
        self._step = now + steps
        return terms

    def _now(self, steps: int = 1) -> int:
        """Return the index of the next step; ResetNeeded if fewer steps are left."""
        if self._step is None or self._step + steps > self.horizon:
            what = "no episode has started" if self._step is None else "the episode is over"
            raise ResetNeeded(f"{what}: call reset() before step()")
        return self._step

    def frames(self) -> tuple[np.ndarray, ...]:
        """Draw the current states.

        Returns:
            One picture per sub-environment, shape [height, width, 3], uint8.
        """
        simulator = self._simulator
        if not self._renderers:
            # Imported here: drawing is not for everyone, and its library takes a second to load.
            from plab.render import Renderer

            for scene, mass in zip(self.problem.scenes, self.problem.target_mass, strict=True):
                target = mass if self.picture_target else None
                self._renderers.append(Renderer(scene, target, self.picture_size))
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

    def _observe(self, like: Array = None) -> Array:
        def state() -> Array:
            seen = self._simulator.observe(self._observer.stride, like), self._simulator.poses(like)
            joined = self._observer(*seen, np.float32)
            return joined.float() if on_device(joined) else joined

        return self._sensors(state, like)

    def _seen(self, like: Array = None) -> tuple[Array, Array, Array]:
        """Return observations, loss terms and IoU of the current states."""
        measures = self._simulator.measure(like)
        return self._observe(like), measures.terms, measures.iou

    def _info(self, terms: Array, iou: Array) -> dict[str, Array]:
        score, printed = self.problem.scores_of(iou)
        return {
            "loss": self.problem.loss_of(terms),
            **{f"loss_{name}": terms[:, k] for k, name in enumerate(self.problem.term_names)},
            "iou": iou,
            "score": score,
            "score_printed": printed,
        }


class Restorable:
    """Copies and pickles of an environment: its arguments and its state.

    Attributes:
        batch: The episodes.
    """

    batch: EpisodeBatch
    _arguments: dict[str, Any]

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments, state and random numbers."""
        return {
            "arguments": self._arguments,
            "state": self.batch.get_state(),
            "random": (getattr(self, "_np_random", None), getattr(self, "_np_random_seed", None)),
        }

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Build the environment anew, and put it into the state."""
        self.__init__(**kept["arguments"])  # type: ignore[misc]
        self.batch.set_state(kept["state"])
        self._np_random, self._np_random_seed = kept["random"]

    def get_state(self) -> EpisodeState:
        """Return a copy of the state of the episodes; see :meth:`EpisodeBatch.get_state`."""
        return self.batch.get_state()


def _require_alike(cfgs: Sequence[Config]) -> None:
    """Refuse configurations whose observations hold different entries."""
    for key in OBSERVED:
        if len({getattr(cfg, key) for cfg in cfgs}) > 1:
            raise ArgumentError(f"{key} differs between sub-environments: they share one space")


def _restore_rows(table: Array, before: Array, rows: Sequence[int]) -> None:
    """Replace some rows of a table by those of another, both arrays or CUDA tensors."""
    kept = before[rows]
    if on_device(table):
        kept = kept.to(table) if on_device(kept) else table.new_tensor(kept)
    table[rows] = kept


def _copies(tables: Sequence[Array]) -> tuple[Array, ...]:
    def copy(table: Array) -> Array:
        return table.clone() if on_device(table) else table.copy()

    return tuple(mapped(copy, table) for table in tables)
