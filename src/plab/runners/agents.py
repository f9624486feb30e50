"""Base of ``sac``, ``td3`` and ``ppo``: one or more agents trained in lockstep.

Agents share only kernel launches: their parameters are stacked, [agent, ...], for batched products. Each
agent has its own environments, replay buffer, statistics and random numbers, starts with Stable-Baselines3's
initial networks, and makes the same updates as Stable-Baselines3. An update of these small networks has a
hundred kernels of a few microseconds each, dominated by the time to launch them from Python; on CUDA updates
are captured as a graph and replayed with one launch.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from plab.config import Config, ranges
from plab.plugins import Tensor, torch
from plab.results import ResultsError
from plab.runners.policy import Policy, PolicyConfig, Spaces, first_policy

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy

LARGEST = 2**62
"""Bound of the random integers that are reduced modulo the requested range; uniform to 1e-12."""


@dataclass
class RlConfig(PolicyConfig):
    """Keys of all reinforcement-learning methods.

    Attributes:
        profile: Profile with the default values; None without profiles.
        num_envs: Environments simulated together.
        gamma: Discount factor.
        profiles: Values by profile. Empty in a run's configuration, whose fields have the values.
    """

    profile: str | None
    num_envs: int = field(metadata=ranges.COUNT)
    gamma: float = field(metadata=ranges.SHARE)
    profiles: dict[str, Any]


@dataclass
class OffPolicyConfig(RlConfig):
    """Keys of off-policy methods, which use a replay buffer.

    Attributes:
        buffer_size: Transitions kept for replay.
        batch_size: Transitions per update.
        learning_starts: Steps of uniformly random actions before the first update.
        tau: Update rate of the target networks.
        gradient_steps: Updates per step of all environments; -1 makes one per transition.
    """

    buffer_size: int
    batch_size: int = field(metadata=ranges.COUNT)
    learning_starts: int = field(metadata=ranges.NOT_NEGATIVE)
    tau: float = field(metadata=ranges.SHARE)
    gradient_steps: int

    def check(self, path: str) -> None:
        super().check(path)
        ranges.at_least(f"{path}.buffer_size", self.buffer_size, self.num_envs)
        if self.gradient_steps != -1:
            ranges.at_least(f"{path}.gradient_steps", self.gradient_steps, 1)


class AgentRandom:
    """Independent random number generators of K agents on a device."""

    BLOCK = 50
    """Number of entries sampled at once by :meth:`block`."""

    def __init__(self, seeds: Sequence[int], device: torch.device) -> None:
        """Seed a generator per agent."""
        self._generators = [torch.Generator(device).manual_seed(seed) for seed in seeds]
        self._device = device
        self._rest: dict[str, list[Tensor]] = {}

    def draw(self, kind: str, *shape: int) -> Tensor:
        """Sample numbers, shape [agent, *shape]: ``normal``, ``uniform`` in [-1, 1), ``integers`` in [0,
        :data:`LARGEST`), or a ``permutation`` of the integers below the only entry of ``shape``."""
        kinds: dict[str, Any] = {"normal": torch.randn, "uniform": torch.rand, "permutation": torch.randperm}
        kinds["integers"] = lambda *shape, **options: torch.randint(LARGEST, shape, **options)
        drawn = [kinds[kind](*shape, generator=own, device=self._device) for own in self._generators]
        return torch.stack(drawn) * 2.0 - 1.0 if kind == "uniform" else torch.stack(drawn)

    def block(self, use: str, kind: str, *shape: int) -> Tensor:
        """Return the next entry, shape [agent, *shape], of a named block of random numbers, which is refilled
        when exhausted."""
        if not self._rest.get(use):
            self._rest[use] = list(self.draw(kind, self.BLOCK, *shape).unbind(1))[::-1]
        return self._rest[use].pop()

    def states(self) -> list[np.ndarray]:
        """Return each generator's state, and drop the blocks, because a resumed process has none."""
        self._rest = {}
        return [generator.get_state().numpy() for generator in self._generators]

    def restore(self, agent: int, state: np.ndarray) -> None:
        """Restore an agent's generator from a state returned by :meth:`states`."""
        self._generators[agent].set_state(torch.from_numpy(np.array(state, np.uint8)))


# --------------------------------------------------------------------------------------------- replay buffers


class Sizes(NamedTuple):
    """Sizes of an agent's episodes: environments N, steps T, observation entries and action components."""

    envs: int
    horizon: int
    observed: int
    actions: int

    @property
    def entries(self) -> int:
        """Number of float32 values of one episode in all N environments."""
        return self.envs * ((self.horizon + 1) * self.observed + self.horizon * (self.actions + 1))

    def capacity(self, buffer_size: int, total_steps: int) -> int:
        """Return how many episodes of N environments a buffer for a number of transitions holds."""
        # One more, because the oldest samples may begin, and the latest end, within an episode.
        held = math.ceil(buffer_size // self.envs / self.horizon) + 1
        return min(math.ceil(total_steps / self.envs / self.horizon), held)


class ReplayBuffer:
    """Transitions of K agents in lockstep; each observation is stored once.

    Attributes:
        added: Number of steps of all N environments added so far, including overwritten ones.
    """

    def __init__(
        self, agents: int, sizes: Sizes, buffer_size: int, total_steps: int, device: torch.device
    ) -> None:
        """Allocate buffers for the latest transitions, given the number of training transitions."""
        self.added = 0
        self._sizes, self._window = sizes, buffer_size // sizes.envs
        self._capacity = capacity = sizes.capacity(buffer_size, total_steps)
        n, horizon = sizes.envs, sizes.horizon
        shape = agents, capacity
        self._observations = torch.empty((*shape, horizon + 1, n, sizes.observed), device=device)
        self._actions = torch.empty((*shape, horizon, n, sizes.actions), device=device)
        self._rewards = torch.empty((*shape, horizon, n), device=device)
        # Range of samples for captured updates: first step, and number of steps.
        self._first = torch.zeros((), dtype=torch.int64, device=device)
        self._count = torch.ones((), dtype=torch.int64, device=device)
        self._agent = torch.arange(agents, device=device).unsqueeze(1)
        # Number of episodes of N environments in each agent's file.
        self._written = [0] * agents

    def add(self, observations: Tensor, actions: Tensor, rewards: Tensor, next_observations: Tensor) -> None:
        """Append one step of all environments; arguments of shape [agent, env, ...]."""
        episode, step = divmod(self.added, self._sizes.horizon)
        slot = episode % self._capacity
        if step == 0:
            self._observations[:, slot, 0] = observations
        self._observations[:, slot, step + 1] = next_observations
        self._actions[:, slot, step] = actions
        self._rewards[:, slot, step] = rewards
        self._count_to(self.added + 1)

    def _count_to(self, added: int) -> None:
        self.added = added
        self._first.fill_(added - self.count)
        self._count.fill_(max(self.count, 1))

    @property
    def count(self) -> int:
        """Number of steps of all N environments that can be sampled."""
        return min(self.added, self._window)

    def sample(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Sample transitions uniformly, given large random integers, shape [agent, row]; return observations,
        actions and next observations, shape [agent, row, entry], and rewards, shape [agent, row]."""
        n, horizon = self._sizes.envs, self._sizes.horizon
        env, steps = numbers % n, self._first + numbers // n % self._count
        episode = self._agent * self._capacity + steps // horizon % self._capacity
        step = steps % horizon
        first = ((episode * (horizon + 1) + step) * n + env).reshape(-1)
        place = ((episode * horizon + step) * n + env).reshape(-1)
        observations = self._observations.view(-1, self._sizes.observed)
        shape = *numbers.shape, -1
        return (
            observations.index_select(0, first).view(shape),
            self._actions.view(-1, self._sizes.actions).index_select(0, place).view(shape),
            observations.index_select(0, first + n).view(shape),
            self._rewards.view(-1).index_select(0, place).view(numbers.shape),
        )

    def write(self, agent: int, path: Path) -> None:
        """Append an agent's new episodes to its file, so that the file covers every checkpoint; raise
        ResultsError on failure."""
        since, last = self._written[agent], self.added // self._sizes.horizon
        try:
            with path.open("r+b" if since else "wb") as file:
                file.seek(since * self._sizes.entries * 4)
                for episode in range(since, last):
                    for part in self._parts(agent, episode):
                        file.write(part.cpu().numpy().data)
        except OSError as error:
            raise ResultsError(f"cannot write the replay buffer {path}: {error.strerror or error}") from error
        self._written[agent] = last

    def read(self, agent: int, path: Path, steps: int) -> None:
        """Load whole episodes of N environments from an agent's file, given the number of transitions, which
        is equal for all agents; raise ResultsError on failure."""
        added = steps // self._sizes.envs
        self._count_to(added)
        self._written[agent] = last = added // self._sizes.horizon
        first = max(0, last - self._capacity)
        try:
            with path.open("rb") as file:
                file.seek(4 * first * self._sizes.entries)
                for episode in range(first, last):
                    for part in self._parts(agent, episode):
                        numbers = np.fromfile(file, np.float32, part.numel())
                        part.copy_(torch.from_numpy(numbers).view(part.shape))
        except (OSError, RuntimeError) as error:
            # The file is missing or shorter than required by the checkpoint.
            remedy = "start again with force=true"
            raise ResultsError(f"cannot read the replay buffer {path}: {error}; {remedy}") from error

    def _parts(self, agent: int, episode: int) -> list[Tensor]:
        """Return the locations of an episode in the buffers, in file order."""
        tables = self._observations, self._actions, self._rewards
        return [table[agent, episode % self._capacity] for table in tables]


# --------------------------------------------------------------------------------------------------- networks

Part: TypeAlias = "dict[str, Tensor]"
"""Parameters by name in their module, each of shape [stack, ...]; weights are stored transposed, [stack, in,
out], to avoid transposing products and gradients."""


def stacked(
    policies: Sequence[torch.nn.Module], parts: Mapping[str, Sequence[str]], device: torch.device
) -> dict[str, Part]:
    """Return the stacked parameters of policies of one kind, by part: a module, or several modules of the
    same shape.

    Modules that are evaluated together, such as two critics, form one part; its stack has the modules of the
    first policy, then those of the second, etc.
    """
    named = [dict(policy.named_parameters()) for policy in policies]
    stacks: dict[str, Part] = {}
    for part, modules in parts.items():
        # Of a module "a.b" the parameter "a.b.weight" is "weight", of a parameter "a" itself the name "".
        names = [n[len(modules[0]) :] for n in named[0] if f"{n}.".startswith(f"{modules[0]}.")]
        stacks[part] = {
            name.lstrip("."): torch.stack([_transposed(own[m + name]) for own in named for m in modules])
            .to(device)
            .requires_grad_()
            for name in names
        }
    return stacks


def _transposed(parameter: Tensor) -> Tensor:
    return parameter.detach().mT if parameter.ndim == 2 else parameter.detach()


def flat(tensors: Sequence[Tensor], agents: int) -> Tensor:
    """Return stacked tensors as one row per agent, shape [agent, number]."""
    return torch.cat([tensor.detach().reshape(agents, -1) for tensor in tensors], dim=1)


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return x W + b for each network: shapes [stack, row, in], [stack, in, out], [stack, out]."""
    return torch.baddbmm(bias.unsqueeze(1), x, weight)


def mlp(
    x: Tensor, tensors: Iterable[Tensor], activation: Callable[[Tensor], Tensor], *, linear_last: bool
) -> Tensor:
    """Evaluate a stacked ``nn.Sequential`` of linear layers, given their weights and biases, for x of shape
    [stack, row, in]. An activation follows each layer, except the last one if ``linear_last``."""
    tensors = list(tensors)
    for k in range(0, len(tensors), 2):
        x = linear(x, *tensors[k : k + 2])
        x = x if linear_last and k + 2 == len(tensors) else activation(x)
    return x


def critic_values(tensors: Iterable[Tensor], observations: Tensor, actions: Tensor) -> Tensor:
    """Return the values of stacked critics, given their weights and biases, shape [agent, critic, row]."""
    weight, bias, *others = tensors
    agents, critics = len(observations), len(weight) // len(observations)
    observations, actions = (x.repeat_interleave(critics, dim=0) for x in (observations, actions))
    # Separate products, because backpropagation to the actions then omits the long observations.
    by_observation, by_action = weight.split([observations.shape[2], actions.shape[2]], dim=1)
    first = torch.baddbmm(linear(observations, by_observation, bias), actions, by_action)
    values = mlp(torch.relu(first), others, torch.relu, linear_last=True)
    return values.view(agents, critics, -1)


def adam(parameters: Sequence[Tensor], lr: float, **options: Any) -> torch.optim.Adam:
    """Return Adam for stacked parameters, with preallocated state; one step updates all agents and can be
    captured on CUDA."""
    cuda, device = parameters[0].is_cuda, parameters[0].device
    rate: Any = torch.tensor(lr, device=device) if cuda else lr
    optimizer = torch.optim.Adam(parameters, lr=rate, fused=True, capturable=cuda, **options)
    for parameter in parameters:
        moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
        optimizer.state[parameter] = {"step": torch.zeros((), device=device), **moments}
    return optimizer


def descend(optimizer: torch.optim.Adam, losses: Tensor, longest: float | None = None) -> None:
    """Make an optimiser step on the independent losses of the agents, shape [agent], with each agent's
    gradient clipped to the norm ``longest``."""
    parameters = optimizer.param_groups[0]["params"]
    gradients = torch.autograd.grad(losses.sum(), parameters)
    if longest is not None:
        agents = len(losses)
        norms = torch.linalg.vector_norm(flat(gradients, agents), dim=1)
        scale = (longest / (norms + 1e-6)).clamp(max=1.0)
        gradients = tuple((g.reshape(agents, -1) * scale.unsqueeze(1)).reshape(g.shape) for g in gradients)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        # A joint step reads the numbers in memory order.
        parameter.grad = gradient.contiguous()
    optimizer.step()


def follow(targets: list[Tensor], sources: list[Tensor], tau: float) -> None:
    """Update target networks: target <- (1 - tau) target + tau source."""
    with torch.no_grad():
        torch._foreach_lerp_(targets, sources, tau)


WARM_UP = 3
"""Number of updates before graph capture, during which libraries and optimisers allocate memory."""


class CapturedUpdate:
    """An update of a model; on CUDA it is captured once per shape of its arguments and then replayed.

    The function may change parameters and optimisers in place, and may sample random numbers on the device.
    It must not synchronise with the device, and all data except its arguments must keep their addresses.
    """

    def __init__(self, update: Callable[..., Tensor]) -> None:
        """Wrap an update, a function of tensors that returns a tensor."""
        self._update = update
        # By shapes of the arguments: graph, input tensors, and output tensor.
        self._recordings: dict[Any, tuple[torch.cuda.CUDAGraph, tuple[Tensor, ...], Tensor]] = {}
        self._calls = 0

    def __call__(self, *arguments: Tensor) -> Tensor:
        """Make an update; the next call overwrites the returned tensor."""
        if not arguments[0].is_cuda:
            return self._update(*arguments)
        self._calls += 1
        if self._calls <= WARM_UP:
            # In a separate stream, as required for capture.
            stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
            stream.wait_stream(current)
            with torch.cuda.stream(stream):
                result = self._update(*arguments)
            current.wait_stream(stream)
            return result
        shapes = tuple(argument.shape for argument in arguments)
        if shapes not in self._recordings:
            own, graph = tuple(argument.clone() for argument in arguments), torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                self._recordings[shapes] = graph, own, self._update(*own)
        graph, own, result = self._recordings[shapes]
        for mine, given in zip(own, arguments, strict=True):
            mine.copy_(given)
        graph.replay()
        return result


# ----------------------------------------------------------------------------------------------------- agents


class Agents:
    """K agents trained in lockstep; each is equivalent to a single agent.

    Attributes:
        sizes: Sizes of the episodes.
        steps: Number of transitions per agent so far.
        updates: Number of updates per agent so far.
        networks: Parameters by part.
        optimizers: Adam optimisers of parts of the networks, by name.
        tensors: Additional tensors of a checkpoint, by name, each of shape [agent, ...].
    """

    PARTS: ClassVar[Mapping[str, Sequence[str]]]
    """Modules of Stable-Baselines3's policy, by part; see :func:`stacked`."""

    LOSSES: ClassVar[Sequence[str]]
    """Names of the losses returned by an update, as in Stable-Baselines3's logs."""

    optimizers: dict[str, torch.optim.Adam]

    def __init__(
        self, cfgs: Sequence[Config], spaces: Spaces, device: torch.device, total_steps: int
    ) -> None:
        """Initialise untrained networks for configurations with equal ``method`` sections, one per agent, and
        a total number of transitions."""
        self.method, self.device, self.count = cfgs[0].method_as(RlConfig), device, len(cfgs)
        first = [first_policy(self.method, spaces, cfg.seed) for cfg in cfgs]
        self.sizes = Sizes(self.method.num_envs, cfgs[0].sim.horizon, *spaces.sizes)
        self.total_steps, self._spaces = total_steps, spaces
        self.steps = self.updates = 0
        self.random = AgentRandom([cfg.seed for cfg in cfgs], device)
        self.networks = stacked(first, self.PARTS, device)
        self.tensors: dict[str, Tensor] = {}
        self._updates: dict[Hashable, CapturedUpdate] = {}
        self._logged = any(cfg.logger != "none" for cfg in cfgs)
        self._losses: dict[str, list[Tensor]] = {}
        self.build()

    @abstractmethod
    def build(self) -> None:
        """Create optimisers, buffers and additional tensors."""

    @staticmethod
    @abstractmethod
    def make_policy(method: Any, spaces: Spaces) -> BasePolicy:
        """Return Stable-Baselines3's policy with initial weights, on the CPU."""

    def policy(self, agent: int) -> Policy:
        """Return the policy of an agent."""
        network = first_policy(self.method, self._spaces)
        own = dict(network.named_parameters())
        with torch.no_grad():
            for part, modules in self.PARTS.items():
                for name, tensor in self.networks[part].items():
                    rows = tensor.reshape(self.count, len(modules), *tensor.shape[1:])[agent]
                    for module, row in zip(modules, rows, strict=True):
                        own[f"{module}.{name}".rstrip(".")].copy_(_transposed(row))
        return Policy(network)

    def parameters(self, *parts: str) -> list[Tensor]:
        """Return the stacked parameters of the named parts, or of all parts."""
        return [tensor for part in parts or self.networks for tensor in self.networks[part].values()]

    @classmethod
    def cycle_steps(cls, method: Any, horizon: int) -> int:
        """Return the number of transitions per training cycle: a batch of episodes, or an update."""
        return method.num_envs * horizon

    def begin(self, observations: Tensor) -> None:
        """Set the initial observations of the training, shape [agent, env, entry]."""

    @abstractmethod
    def act(self, observations: Tensor) -> Tensor:
        """Return exploratory actions, shape [agent, env, action], for observations of all environments."""

    @abstractmethod
    def decide(self, observations: Tensor) -> Tensor:
        """Return the actions of the deterministic policy, shape [agent, row, action], in [-1, 1]."""

    @abstractmethod
    def learn(self, rewards: Tensor, last: Tensor, observations: Tensor, *, over: bool) -> None:
        """Process the results of the latest actions: rewards, shape [agent, env], and next observations,
        shape [agent, env, entry]; make all pending updates. The next step starts from ``observations``,
        which differ from the last ones if the episodes are ``over``."""

    def _tables(self) -> dict[str, list[Tensor]]:
        """Return the stacked tensors with one row per agent, by their names in an agent's state."""
        tables = {"networks": self.parameters()}
        tables |= {name: [tensor] for name, tensor in self.tensors.items()}
        for name, optimizer in self.optimizers.items():
            for moment in ("exp_avg", "exp_avg_sq"):
                tables[f"{name}_{moment}"] = [own[moment] for own in optimizer.state.values()]
        return tables

    def states(self) -> list[dict[str, Any]]:
        """Return the full training state of each agent, except its replay buffer."""
        rows = {name: flat(tensors, self.count).cpu().numpy() for name, tensors in self._tables().items()}
        shared = {"steps": self.steps, "updates": self.updates}
        for name, optimizer in self.optimizers.items():
            shared[f"{name}_steps"] = int(next(iter(optimizer.state.values()))["step"])
        return [
            {**shared, **{name: table[k].copy() for name, table in rows.items()}, "random": random}
            for k, random in enumerate(self.random.states())
        ]

    def restore(self, agent: int, state: Mapping[str, Any]) -> None:
        """Restore an agent from a state returned by :meth:`states`; the other agents must be restored to the
        same step. Raise RuntimeError if the state does not fit."""
        for name, tensors in self._tables().items():
            own = [tensor.detach().view(self.count, -1)[agent] for tensor in tensors]
            numbers = torch.from_numpy(state[name]).split([part.numel() for part in own])
            for part, known in zip(own, numbers, strict=True):
                part.copy_(known)
        self.steps, self.updates = int(state["steps"]), int(state["updates"])
        for name, optimizer in self.optimizers.items():
            for kept in optimizer.state.values():
                kept["step"].fill_(int(state[f"{name}_steps"]))
        self.random.restore(agent, state["random"])

    def take_losses(self) -> list[dict[str, float]]:
        """Return each agent's mean losses since the last call, by name in a log."""
        means = {f"train/{name}": torch.stack(rows).mean(0).tolist() for name, rows in self._losses.items()}
        self._losses = {}
        return [{name: row[agent] for name, row in means.items()} for agent in range(self.count)]

    def _note(self, losses: Tensor) -> None:
        """Record the losses of an update, shape [loss, agent]; the last of :attr:`LOSSES` may be missing."""
        if self._logged:
            for name, row in zip(self.LOSSES, losses.clone(), strict=False):
                self._losses.setdefault(name, []).append(row)

    def _captured(self, update: Callable[..., Tensor], *arguments: Tensor, **options: bool) -> Tensor:
        """Call a function that is captured as a CUDA graph for each value of its options; the next call
        overwrites its results."""
        key = update.__name__, *options.items()
        return self._updates.setdefault(key, CapturedUpdate(partial(update, **options)))(*arguments)


class OffPolicyAgents(Agents):
    """Agents that learn from a replay buffer."""

    method: OffPolicyConfig

    def build(self) -> None:
        size = self.method.buffer_size
        self.replay = ReplayBuffer(self.count, self.sizes, size, self.total_steps, self.device)

    @abstractmethod
    def explore(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Return the policy's actions with noise, given standard normal numbers of the same shape."""

    @abstractmethod
    def update(self) -> None:
        """Make one update."""

    def act(self, observations: Tensor) -> Tensor:
        """Return random actions initially, and noisy actions of the policy later."""
        self._observations = observations
        if self.steps < self.method.learning_starts:
            shape = self.sizes.envs, self.sizes.actions
            self._actions = self.explore_at_random(self.random.block("start", "uniform", *shape))
        else:
            self._actions = self._captured(self.explore, observations, self.noise()).clone()
        return self._actions

    def noise(self) -> Tensor:
        """Sample standard normal noise for the environments' actions, shape [agent, env, action]."""
        return self.random.block("noise", "normal", self.sizes.envs, self.sizes.actions)

    def explore_at_random(self, actions: Tensor) -> Tensor:
        """Return the actions used before learning starts, given uniformly random actions."""
        return actions

    def learn(self, rewards: Tensor, last: Tensor, observations: Tensor, *, over: bool) -> None:
        """Store the transitions, and make one update per transition, or ``gradient_steps`` updates."""
        self.replay.add(self._observations, self._actions, rewards, last)
        self.steps += self.sizes.envs
        if self.steps > self.method.learning_starts:
            wanted = self.method.gradient_steps
            for _ in range(self.sizes.envs if wanted < 0 else wanted):
                self.updates += 1
                self.update()
