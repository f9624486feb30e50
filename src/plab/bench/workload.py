"""What the speed benchmarks run: a batch of environments in the middle of a demonstration."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from plab.config import Config, build_scene
from plab.demonstrations import known_actions
from plab.losses import make_terms
from plab.objective import OBSERVED_PARTICLES, target_sdf
from plab.sim import Simulator

if TYPE_CHECKING:
    import torch

__all__ = [
    "FORWARD",
    "GRADIENT",
    "KINDS",
    "OBSERVATION",
    "REWARD",
    "ROLLOUT",
    "TENSORS",
    "Timing",
    "Workload",
    "build",
    "peak_rss_mb",
    "restart_peak_rss",
    "time_calls",
]

FORWARD = "forward"
REWARD = "forward + reward"
OBSERVATION = "forward + reward + observation"
TENSORS = "forward + reward + observation, tensors"
ROLLOUT = "rollout + losses"
GRADIENT = "forward + backward"

NOISE = 0.02
"""Actions of the environments of a batch differ by this much, so that no two do the same."""

SOLID = 0.1
"""Share of the largest mass from which on a node belongs to the target."""

WARM_UP = 2
"""Calls after the first, which compiles, that are not counted: the CPU's kernels try sizes of their teams."""


@dataclass(frozen=True)
class Workload:
    """A simulator and the actions to time.

    Attributes:
        cfg: The configuration of all environments.
        simulator: Their simulator; its initial state is where the actions start.
        actions: Actions, shape [batch, T, A].
        first_step_s: Seconds of the very first step, which compiles or loads from Taichi's cache.
    """

    cfg: Config
    simulator: Simulator
    actions: np.ndarray
    first_step_s: float

    @property
    def steps(self) -> int:
        """Environment steps of a rollout."""
        return self.actions.shape[1]

    @cached_property
    def tensor(self) -> torch.Tensor:
        """The actions on the device."""
        # Imported here: it takes time and memory, which no other kind should be charged with.
        import torch

        return torch.as_tensor(self.actions, device="cuda")

    def call(self, kind: str) -> Callable[[], object]:
        """Return what is timed: a rollout of one of the :data:`KINDS`."""
        if kind == TENSORS:
            # The way to the device is no part of what is timed.
            _ = self.tensor
        return lambda: KINDS[kind](self)


def build(
    cfg: Config,
    batch: int,
    steps: int,
    *,
    from_start: bool = False,
) -> Workload:
    """Build a simulator and put it where the plasticine is being worked on.

    Targets cost time to make and none to compare with, so the target is the initial shape, moved.

    Args:
        cfg: The configuration.
        batch: Number of environments.
        steps: Environment steps of a rollout.
        from_start: Start at the scene's own initial state, instead of in the middle of the best actions
            known.

    Raises:
        plab.scenes.SceneError: If the scene cannot be simulated.
        plab.targets.TargetError: If the target, which the best actions come from, has a mistake.
        plab.sim.DeviceError: If CUDA was asked for and is not there.
    """
    scene = build_scene(cfg)
    simulator = Simulator(
        [scene] * batch,
        terms=make_terms(cfg.method.loss_weights, cfg.method.loss_terms),
        precision=cfg.sim.precision,
        device=cfg.sim.device,
        memory_mb=cfg.sim.memory_mb,
        deterministic=cfg.sim.deterministic,
    )
    simulator.set_contact(cfg.method.contact, softness=cfg.method.softness)
    mass = np.roll(simulator.mass_tensor()[0], scene.grid_size // 16, axis=0)
    # Relative to its largest: with few particles all masses are small.
    distance = target_sdf(mass, threshold=SOLID * mass.max())
    shape = (batch, *mass.shape)
    simulator.set_target(np.broadcast_to(mass, shape), np.broadcast_to(distance, shape))
    actions = _actions(cfg, batch, scene.action_dim)
    begin = time.perf_counter()
    simulator.step(actions[:, 0])
    first_step_s = time.perf_counter() - begin
    first = 0
    if not from_start:
        first = max(0, actions.shape[1] // 2 - steps // 2)
        _run(simulator, actions[:, :first])
        idle = _before_contact(simulator, actions[:, first:])
        _run(simulator, actions[:, first : first + idle])
        first += idle
        simulator.set_initial_state(simulator.state())
    chosen = np.arange(first, first + steps) % actions.shape[1]
    return Workload(cfg, simulator, actions[:, chosen], first_step_s)


def _run(simulator: Simulator, actions: np.ndarray) -> None:
    """Go through actions, shape [batch, T, A], from the initial state."""
    simulator.reset()
    for t in range(actions.shape[1]):
        simulator.step(actions[:, t])


def _before_contact(simulator: Simulator, actions: np.ndarray) -> int:
    """Take the state for the initial one, and return how many steps by actions, shape [batch, T, A], go by
    before a manipulator touches a body; 0 if none does."""
    simulator.set_initial_state(simulator.state())
    simulator.reset()
    for t in range(actions.shape[1]):
        simulator.step(actions[:, t])
        if simulator.steps_before_contact(1) == 0:
            return t
    return 0


def _actions(cfg: Config, batch: int, width: int) -> np.ndarray:
    """Return an episode's actions, shape [batch, T, A]: the best known, or random ones where none are."""
    rng = np.random.default_rng(0)
    known = known_actions(cfg)
    if known is None:
        known = rng.uniform(-0.5, 0.5, size=(cfg.sim.horizon, width))
    return np.clip(known + rng.uniform(-NOISE, NOISE, size=(batch, *known.shape)), -1.0, 1.0)


def _forward(
    load: Workload, *, reward: bool = False, observation: bool = False, tensors: bool = False
) -> None:
    simulator = load.simulator
    simulator.reset()
    stride = max(simulator.particle_count // OBSERVED_PARTICLES, 1)
    like = load.tensor if tensors else None
    actions = load.actions if like is None else like
    for t in range(load.steps):
        simulator.step(actions[:, t], check=not reward)
        if observation:
            simulator.observe(stride, like)
            simulator.poses(like)
        if reward:
            simulator.measure(like)
    ti.sync()


def _rollout(load: Workload, gradient: bool) -> None:
    load.simulator.rollout(load.actions, gradient)
    ti.sync()


KINDS: dict[str, Callable[[Workload], None]] = {
    FORWARD: _forward,
    REWARD: lambda load: _forward(load, reward=True),
    OBSERVATION: lambda load: _forward(load, reward=True, observation=True),
    TENSORS: lambda load: _forward(load, reward=True, observation=True, tensors=True),
    ROLLOUT: lambda load: _rollout(load, gradient=False),
    GRADIENT: lambda load: _rollout(load, gradient=True),
}
"""What can be timed. The reward is what every step's is made of, loss terms and IoU, on the host; the
observation is what the environments return. With tensors, actions, rewards and observations are on the
device, as in training there; on the CPU there is no such row. A rollout is one call for all steps and their
loss terms, as for the optimisers; the backward pass includes it."""


@dataclass(frozen=True)
class Timing:
    """Times of a call.

    Attributes:
        first_s: Seconds of the first call; it compiles, or loads from Taichi's cache.
        seconds: Seconds of each counted call, shape [repeat].
    """

    first_s: float
    seconds: np.ndarray

    def ms(self, steps: int) -> np.ndarray:
        """Milliseconds per environment step: median, least, most."""
        values = self.seconds / steps * 1e3
        return np.array([np.median(values), values.min(), values.max()])


def time_calls(call: Callable[[], object], repeats: int) -> Timing:
    """Time a call that leaves nothing running: once cold, and ``repeats`` times after the warm-up."""
    start = time.perf_counter()
    call()
    first = time.perf_counter() - start
    for _ in range(WARM_UP):
        call()
    seconds = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter()
        call()
        seconds[i] = time.perf_counter() - start
    return Timing(first, seconds)


def restart_peak_rss() -> None:
    """Start the process's peak resident memory anew, where Linux allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_rss_mb() -> float:
    """Peak resident memory of the process [MB] since it was started anew; NaN where it is not known."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(
        (int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM")), float("nan")
    )
