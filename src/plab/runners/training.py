"""Base classes of runners that train policies, one per run, and evaluate them in the hard contact model.

:class:`PolicyRunner` alternates between some episodes of training and one episode of each deterministic
policy, which produces a row of the results. :class:`ActorRunner`, the base of ``shac``, ``pods`` and ``bc``,
trains one policy, with its networks, state and random scenes.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from plab.config import Config, ConfigError, build_scene, ranges
from plab.config.randomization import without_draws
from plab.config.selection import OBSERVATION_KEYS
from plab.plugins import Tensor, torch
from plab.results.run_file import REPLAY_SUFFIX
from plab.runners.policy import (
    CLIP,
    Policy,
    PolicyConfig,
    Spaces,
    first_policy,
    packed,
    save_policy,
    torch_settings,
    unpacked,
)
from plab.runners.runner import (
    FINAL_STATE_COLUMNS,
    Runner,
    SimulatorCache,
    Step,
    TogetherError,
    Track,
    episode_columns,
    simulator_key,
)

if TYPE_CHECKING:
    from plab.envs.core import EpisodeBatch
    from plab.envs.tensors import TensorEnv
    from plab.runners.agents import ReplayBuffer

DEVIATION_MIN = 0.01
"""Least standard deviation for scaling observations [domain units, domain units / s]. Otherwise nearly
constant entries, scaled up, would dominate the gradient through the policy."""

_log = logging.getLogger(__name__)


def evaluate(
    env: TensorEnv, decide: Callable[[Tensor], Tensor]
) -> tuple[list[dict[str, float]], np.ndarray, Mapping[int, str]]:
    """Run an episode of a deterministic policy in each environment of a batch.

    Args:
        env: The environments. Diverged ones are frozen, see :meth:`plab.envs.core.EpisodeBatch.step`.
        decide: Function from observations, shape [env, entry], to actions, shape [env, A].

    Returns:
        Values of :func:`plab.runners.runner.episode_columns` for each environment; actions, shape
        [env, T, A]; and times and reasons of divergence by environment.
    """
    columns = episode_columns(env.batch.problem.term_names)
    final = torch.tensor([[name in FINAL_STATE_COLUMNS] for name in columns], device=env.device)
    observations, totals = env.reset(), torch.zeros(())
    actions: list[Tensor] = []
    for _ in range(env.batch.horizon):
        actions.append(decide(observations))
        done = env.step(actions[-1].double().nan_to_num(), strict=False)
        values = done.info | {"reward": done.reward}
        row = torch.stack([values[name] for name in columns])
        totals = torch.where(final, row, totals + row)
        observations = done.observation
    measures = [dict(zip(columns, own, strict=True)) for own in totals.T.tolist()]
    return measures, torch.stack(actions, dim=1).cpu().numpy(), done.failures


def shared_batches(cache: SimulatorCache, *kinds: tuple[Sequence[Config], str]) -> list[EpisodeBatch]:
    """Return batches of environments in their initial states, each for some configurations and a contact
    model, reused from the last run if compatible."""
    # Imported here, because it imports the simulator.
    from plab.envs.core import EpisodeBatch

    key: list[Hashable] = []
    for cfgs, contact in kinds:
        cfg = cfgs[0]
        key += [simulator_key(cfg, build_scene(cfg)), cfg.sim.horizon, len(cfgs), contact]
        key += [getattr(cfg, name) for name in OBSERVATION_KEYS]
    return cache.get(
        tuple(key),
        lambda: [EpisodeBatch(cfgs, contact=contact) for cfgs, contact in kinds],
        check=lambda batches: [batch.renew(own) for batch, (own, _) in zip(batches, kinds, strict=True)],
    )


class PolicyRunner(Runner, ABC):
    """Base class of runners that train policies in lockstep; each iteration consists of some training
    episodes and one evaluation episode per policy.

    Training proceeds in cycles of a batch of episodes or an update. All runs are at the same evaluation; if
    one fails, the others restart without it.

    Attributes:
        batch: Environments of the training.
        total_steps: Total number of transitions per policy, in whole cycles.
        simulates: Whether there are training environments.
        measured: Values of each policy's finished episodes since its last evaluation, by column of results;
            the rows have their means, or NaN if no episode has finished.
        broken: Times and reasons of their divergence; diverged environments are frozen until their episode
            ends.
    """

    round_episodes: tuple[int, int] = 1, 0
    """Episodes per environment in a cycle, and episodes with gradient."""

    tf32 = False

    # ------------------------------------------------------------------------------------------------ hooks

    def environments(self, cfg: Config) -> list[Config]:
        """Return the configurations of training environments; none if no simulations are needed."""
        return [cfg] * cast(Any, cfg.method).num_envs

    @abstractmethod
    def prepare(self, batch: EpisodeBatch) -> None:
        """Create the untrained policies, given the environments, and call :meth:`set_cycle`."""

    @property
    @abstractmethod
    def steps(self) -> int:
        """Number of transitions per policy so far."""

    @abstractmethod
    def cycle(self) -> None:
        """Train for one cycle and report the episodes, without a text."""

    def decide(self, observations: Tensor) -> Tensor:
        """Return the actions of the deterministic policies, shape [run, A], given one observation each, shape
        [run, entry]; by default those of a single policy."""
        return torch.as_tensor(self.policy(0)(observations.cpu().numpy()))

    def losses(self) -> list[dict[str, float]]:
        """Return the mean losses of each policy since the last call, by name in a log; by default none."""
        return [{} for _ in self.tracks]

    @abstractmethod
    def states(self) -> list[dict[str, Any]]:
        """Return the full training state of each policy, except its replay buffer."""

    @abstractmethod
    def restore(self, run: int, state: Mapping[str, Any]) -> None:
        """Restore a policy from a state returned by :meth:`states`; raise RuntimeError, ValueError or
        LookupError if the state belongs to other networks."""

    def replay(self, run: int) -> tuple[ReplayBuffer, int] | None:
        """Return the replay buffer of a policy and the policy's index in it, or None."""
        return None

    @abstractmethod
    def policy(self, run: int) -> Policy:
        """Return a policy."""

    # ------------------------------------------------------------------------------- shared implementation

    def set_cycle(self, batch: EpisodeBatch, cycle: int) -> None:
        """Plan ``method.episodes`` episodes, rounded up to whole cycles, given the number of transitions per
        cycle and policy."""
        self.batch, self._horizon, self._cycle_steps = batch, batch.horizon, cycle
        self.total_steps = math.ceil(self.method.episodes * self._horizon / cycle) * cycle
        self.measured: list[dict[str, list[float]]] = [{} for _ in self.tracks]
        self.broken: list[list[str]] = [[] for _ in self.tracks]

    def note(self, **values: Tensor | np.ndarray) -> None:
        """Record values of finished training episodes, one per environment, in the order of the policies."""
        for name, entries in values.items():
            rows = torch.as_tensor(entries).reshape(len(self.measured), -1).tolist()
            for measured, row in zip(self.measured, rows, strict=True):
                measured.setdefault(name, []).extend(row)

    @property
    def episodes(self) -> int:
        """Number of complete episodes per policy so far."""
        return self.steps // self._horizon

    def context(self) -> AbstractContextManager[Any]:
        # Large first layers dominate the time of an update on a GPU.
        tf32 = self.tf32 and self.method.torch_device == "cuda"
        return torch_settings(self.method.torch_threads, tf32=tf32)

    def build(self) -> None:
        """Create the training environments, and the evaluation environments in the hard contact model."""
        from plab.envs.tensors import TensorEnv

        cfgs = [track.cfg for track in self.tracks]
        training = [one for cfg in cfgs for one in self.environments(cfg)]
        if self.method.torch_device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("method.torch_device=cuda: PyTorch has no CUDA device; choose cpu")
        self.simulates = bool(training)
        kinds = [(training, self.method.contact)] if training else []
        *own, judge = shared_batches(self.cache, *kinds, ([without_draws(cfg) for cfg in cfgs], "hard"))
        self._judge, self.problem = TensorEnv(judge), judge.problem
        self.prepare(*own or [judge])

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Store the initial policy, or restore policy and replay buffer from the file."""
        if state is None:
            return
        self.restore(track.number, state)
        if self.has_more(track) and (found := self.replay(track.number)):
            with track.results_errors():
                found[0].read(found[1], _replay_path(track), self.steps)

    def has_more(self, track: Track) -> bool:
        """Return whether training steps remain, or the initial policy has not been evaluated."""
        return track.iteration == 0 or self.steps < self.total_steps

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Train until the next evaluation, except before the first one, and evaluate all policies."""
        if len(tracks) < len(self.tracks):
            raise TogetherError("a run has failed")
        before = self.steps
        # The first evaluation, of the initial policies, compiles the kernels.
        if tracks[0].iteration > 0:
            self.enter("optimise")
            until = int(tracks[0].run.result.columns["episodes"][-1]) + self.method.evaluate_every
            while self.episodes < until and self.steps < self.total_steps:
                self.cycle()
            self.enter("evaluate")
        measures, actions, failures = evaluate(self._judge, self.decide)
        columns = self._family.columns
        losses, states = self.losses(), self.states()
        every, differentiated = self.round_episodes
        simulated = self.steps - before if self.simulates else 0
        gradient = simulated // every * differentiated
        for k, (track, own, state) in enumerate(zip(tracks, losses, states, strict=True)):
            measured, broken, failure = self.measured[k], self.broken[k], failures.get(k, "")
            self.measured[k], self.broken[k] = {}, []
            # A value stands for all episodes of an environment in a round.
            ended = every * len(measured.get(columns[0], ()))
            if why := _unusable(track, broken, ended, actions[k], failure):
                track.fail(why)
                continue
            means = {name: float(np.mean(measured.get(name, np.nan))) for name in columns}
            with track.results_errors():
                if found := self.replay(track.number):
                    found[0].write(found[1], _replay_path(track))
                track.log.write(own, self.steps)
            if not track.open:
                continue
            step = Step(
                measures[k] | means,
                actions[k],
                state,
                steps=self.steps,
                steps_forward=self._horizon + simulated - gradient,
                steps_gradient=gradient,
                keep=self.steps >= self.total_steps,
                whole=not failure,
            )
            yield track, step

    def extent(self) -> tuple[int, int, int]:
        """Return the numbers of finished and total episodes, and of episodes between evaluations."""
        return self.episodes, self.total_steps // self._horizon, self.method.evaluate_every

    def summary_line(self, means: Mapping[str, float], tracks: Sequence[Track]) -> str:
        return f"reward {means['reward']:.4g} hard score {means['score']:.3f}"

    def conclude(self, track: Track) -> None:
        """Keep the policy of the last evaluation; sampling has ended."""
        save_policy(track.run.path, self.method, self.policy(track.number))
        _replay_path(track).unlink(missing_ok=True)


def _replay_path(track: Track) -> Path:
    return track.run.path.with_suffix(REPLAY_SUFFIX)


def _unusable(track: Track, broken: Sequence[str], ended: int, actions: np.ndarray, failure: str) -> str:
    """Return the reason why a run cannot continue, or an empty string, given the ``broken`` of the ``ended``
    training episodes, and actions and failure of the evaluation. Count diverged episodes in the result's
    provenance, with a warning."""
    if not np.isfinite(actions).all():
        return "the policy's actions are not finite"
    if broken and len(broken) >= ended:
        return f"all {ended} training episodes diverged, the first in {broken[0]}"
    if failure and track.best_actions is None:
        return failure
    for name, texts in (("episodes", broken), ("evaluations", [failure] if failure else [])):
        if texts:
            counts, key = track.run.result.provenance, f"broken_{name}"
            counts[key] = counts.get(key, 0) + len(texts)
            where = track.run.path, track.iteration, len(texts), name, texts[0]
            _log.warning("%s: iteration %d: %d %s diverged and were frozen, the first in %s", *where)
    return ""


# ----------------------------------------------------------------------------------------------- one policy


@dataclass
class ActorConfig(PolicyConfig):
    """Keys of methods that train a policy with the simulator's gradient, in one scene or many.

    Attributes:
        scenes: Number of random training scenes; 0: the run's own scene.
        num_envs: Number of environments simulated together; additional scenes are used in turn.
    """

    scenes: int = field(metadata=ranges.NOT_NEGATIVE)
    num_envs: int = field(metadata=ranges.COUNT)


def actor_network(spaces: Spaces, outputs: int, hidden: Sequence[int]) -> torch.nn.Sequential:
    """Return a network with ELU and LayerNorm after each hidden layer. Without LayerNorm, the hyperbolic
    tangent of the actions saturates and learning stops."""
    (entries,) = spaces.observation_space.shape
    layers: list[torch.nn.Module] = []
    for width in hidden:
        layers += [torch.nn.Linear(entries, width), torch.nn.ELU(), torch.nn.LayerNorm(width)]
        entries = width
    return torch.nn.Sequential(*layers, torch.nn.Linear(entries, outputs))


class ActorRunner(PolicyRunner):
    """Base class of runners that train one policy, with its optimiser and training episodes.

    Attributes:
        network: The policy.
        statistics: Moments of the observations, used for scaling.
        learners: Networks and optimisers of a checkpoint, by name.
    """

    round_episodes, steps = (1, 1), 0

    def environments(self, cfg: Config) -> list[Config]:
        method: Any = cfg.method
        if method.torch_device != cfg.sim.device:
            raise ConfigError(
                f"{method.algorithm} needs its networks on the simulator's device: set "
                f"method.torch_device={cfg.sim.device}, as sim.device"
            )
        return training_scenes(cfg, method.num_envs)

    def prepare(self, batch: EpisodeBatch) -> None:
        """Initialise; the configuration's seed determines initial weights and all random numbers."""
        from stable_baselines3.common.running_mean_std import RunningMeanStd

        self.set_cycle(batch, self.round_episodes[0] * batch.size * batch.horizon)
        self._cfg, self._spaces = self.tracks[0].cfg, Spaces.of(batch)
        self._device = torch.device(self.method.torch_device)
        self.network: Any = first_policy(self.method, self._spaces, self._cfg.seed).to(self._device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=self.method.lr)
        self.learners: dict[str, Any] = {"policy": self.network, "optimizer": self._optimizer}
        self._generator = torch.Generator(self._device).manual_seed(self._cfg.seed)
        self.statistics = RunningMeanStd(shape=self._spaces.observation_space.shape)

    @staticmethod
    def make_policy(method: Any, spaces: Spaces) -> Any:
        """Return Stable-Baselines3's policy with the hyperbolic tangent of :func:`actor_network` as actions
        and torch's default initial weights, on the CPU."""
        from stable_baselines3.common.torch_layers import FlattenExtractor
        from stable_baselines3.td3.policies import Actor

        network = actor_network(spaces, spaces.action_space.shape[0], method.hidden)
        flatten = FlattenExtractor(spaces.observation_space)
        policy = Actor(*spaces, net_arch=[], features_extractor=flatten, features_dim=flatten.features_dim)
        policy.mu = network.append(torch.nn.Tanh())
        return policy

    def cycle(self) -> None:
        self.learn(1.0 - self.steps / self.total_steps)
        self.steps += self._cycle_steps
        self.report(self.episodes, "")

    @abstractmethod
    def learn(self, rate_left: float) -> None:
        """Run a round of training episodes; ``rate_left`` decreases linearly from 1 to 0 during training."""

    def begin_round(self) -> np.ndarray:
        """Take the next scenes if they outnumber the environments; return the round's episode numbers."""
        size = self.batch.size
        turn = self.episodes // (self.round_episodes[0] * size)
        if self.method.scenes > size:
            self.batch.renew(training_scenes(self._cfg, size, turn))
        return turn * size + np.arange(size)

    def policy(self, run: int) -> Policy:
        return Policy(self.network, *self._moments)

    @property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        return self.statistics.mean, np.maximum(self.statistics.var, DEVIATION_MIN**2)

    def freeze_moments(self) -> None:
        """Scale observations by the current moments from now on."""
        mean, variance = (torch.as_tensor(part, dtype=torch.float32) for part in self._moments)
        self._mean, self._deviation = mean.to(self._device), variance.sqrt().to(self._device)

    def scaled(self, observations: torch.Tensor) -> torch.Tensor:
        """Scale observations by the moments at the last :meth:`freeze_moments`."""
        return ((observations - self._mean) / self._deviation).clamp(-CLIP, CLIP)

    def states(self) -> list[dict[str, Any]]:
        return [{"torch": packed(self.state())}]

    def restore(self, run: int, state: Mapping[str, Any]) -> None:
        self.load(unpacked(state["torch"]))

    def state(self) -> dict[str, Any]:
        """Return the full training state, as tensors and numbers."""
        moments = self.statistics.mean, self.statistics.var, self.statistics.count
        return {
            "steps": self.steps,
            "generator": self._generator.get_state(),
            "statistics": [torch.as_tensor(values, dtype=torch.float64) for values in moments],
            **{name: one.state_dict() for name, one in self.learners.items()},
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Restore a state returned by :meth:`state`; raise RuntimeError if it belongs to other networks."""
        for name, one in self.learners.items():
            one.load_state_dict(state[name])
        mean, var, count = state["statistics"]
        self.statistics.mean, self.statistics.var = mean.numpy(), var.numpy()
        self.statistics.count = float(count)
        self._generator.set_state(state["generator"])
        self.steps = state["steps"]


def training_scenes(cfg: Config, count: int, turn: int = 0) -> list[Config]:
    """Return the configurations of ``count`` training environments in a round: the run's own, or the next
    random scenes that fit into the grid, repeated if there are fewer."""
    from plab.problem import drawn_scenes

    scenes, known = [cfg], cfg.method_as(ActorConfig).scenes
    if known:
        some = min(known, count)
        scenes = drawn_scenes(cfg, [(turn * some + k) % known for k in range(some)])
    return [scenes[k % len(scenes)] for k in range(count)]
