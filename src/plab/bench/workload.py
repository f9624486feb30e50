"""Workload of the speed benchmarks: a batch of environments in the middle of a demonstration."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plab.config import Config, load_config
from plab.demonstrations import known_actions
from plab.objective import target_sdf
from plab.problem import make_simulator
from plab.sim import Simulator
from plab.sim.compiler import ti

FORWARD = "forward"
REWARD = "forward + reward"
ROLLOUT = "rollout + losses"
GRADIENT = "forward + backward"

NOISE = 0.02
"""Half width of the noise by which the actions of a batch's environments differ."""

SOLID = 0.1
"""Mass above which a node belongs to the target, as a fraction of the largest node mass."""

WARM_UP = 2
"""Number of warm-up calls after the first, in which the CPU's kernels select their team sizes."""


@dataclass(frozen=True)
class Workload:
    """A simulator and the actions to time.

    Attributes:
        cfg: The configuration of all environments.
        simulator: Simulator; the actions start from its initial state.
        actions: Actions, shape [batch, T, A].
        first_step_s: Duration of the first step [s], which compiles or loads from Taichi's cache.
    """

    cfg: Config
    simulator: Simulator
    actions: np.ndarray
    first_step_s: float

    @property
    def steps(self) -> int:
        """Environment steps per rollout."""
        return self.actions.shape[1]


def with_particles(overrides: Sequence[str], particles: int) -> Config:
    """Compose a configuration with a given number of particles."""
    whole = sum(body.particles for body in load_config(overrides).task.bodies.values())
    return load_config([*overrides, f"sim.particles_scale={particles / whole}"])


def build(cfg: Config, batch: int, steps: int, *, from_start: bool = False) -> Workload:
    """Build a simulator for a batch of environments in a state with contact.

    The target is the shifted initial shape, because generating the task's own target would take time without
    affecting the measurement. A rollout has ``steps`` environment steps; it starts in the middle of the best
    known actions, or with ``from_start`` in the scene's initial state.
    """
    simulator = make_simulator([cfg] * batch)
    scene = simulator.scenes[0]
    simulator.set_contact(cfg.method.contact, softness=cfg.method.softness)
    mass = np.roll(simulator.mass_tensor()[0], scene.grid_size // 16, axis=0)
    # Relative to the largest mass, because masses are small with few particles.
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
        simulator.set_initial_state(simulator.state())
        idle = _run(simulator, actions[:, first:], until_contact=True)
        _run(simulator, actions[:, first : first + idle])
        simulator.set_initial_state(simulator.state())
        first += idle
    chosen = np.arange(first, first + steps) % actions.shape[1]
    return Workload(cfg, simulator, actions[:, chosen], first_step_s)


def _run(simulator: Simulator, actions: np.ndarray, *, until_contact: bool = False) -> int:
    """Simulate actions, shape [batch, T, A], from the initial state; return the number of steps before the
    first contact, which ends ``until_contact``, or 0."""
    simulator.reset()
    for t in range(actions.shape[1]):
        simulator.step(actions[:, t])
        if until_contact and simulator.steps_before_contact(1) == 0:
            return t
    return 0


def _actions(cfg: Config, batch: int, width: int) -> np.ndarray:
    """Return the actions of an episode, shape [batch, T, A]: the best known actions, or random ones."""
    rng = np.random.default_rng(0)
    known = known_actions(cfg)
    if known is None:
        known = rng.uniform(-0.5, 0.5, size=(cfg.sim.horizon, width))
    return np.clip(known + rng.uniform(-NOISE, NOISE, size=(batch, *known.shape)), -1.0, 1.0)


def _forward(load: Workload, reward: bool) -> None:
    load.simulator.reset()
    for t in range(load.steps):
        load.simulator.step(load.actions[:, t], check=not reward)
        if reward:
            load.simulator.measure()
    ti.sync()


def _rollout(load: Workload, gradient: bool) -> None:
    load.simulator.rollout(load.actions, gradient)
    ti.sync()


KINDS: dict[str, Callable[[Workload], None]] = {
    FORWARD: lambda load: _forward(load, reward=False),
    REWARD: lambda load: _forward(load, reward=True),
    ROLLOUT: lambda load: _rollout(load, gradient=False),
    GRADIENT: lambda load: _rollout(load, gradient=True),
}
"""Kinds of timed calls. The reward needs the loss terms and the IoU of every step on the host. A
rollout is one call for all steps and their loss terms, as in optimisers; the backward pass includes it."""


def time_calls(load: Workload, kind: str, repeats: int) -> tuple[float, np.ndarray]:
    """Time one of the :data:`KINDS`, cold and after warm-up.

    Returns:
        Duration of the first call [s], which compiles or loads from Taichi's cache; median, minimum and
        maximum of ``repeats`` calls [ms per environment step].
    """
    seconds = []
    for _ in range(1 + WARM_UP + repeats):
        start = time.perf_counter()
        KINDS[kind](load)
        seconds.append(time.perf_counter() - start)
    ms = np.array(seconds[1 + WARM_UP :]) / load.steps * 1e3
    return seconds[0], np.array([np.median(ms), ms.min(), ms.max()])


def peak_rss_mb() -> float:
    """Peak resident memory of the process [MB]; NaN if unknown."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    peaks = [int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM")]
    return peaks[0] if peaks else float("nan")
