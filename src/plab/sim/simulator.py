"""The simulator: a batch of environments of one kind of scene, forward and differentiated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti

from plab.scene import Scene, SceneError, sample_particles
from plab.sim.engine import CpuEngine
from plab.sim.memory import held_bytes
from plab.sim.order import curve_order
from plab.sim.runtime import SimulationError, is_current, register_user, start_runtime
from plab.sim.skips import Skips
from plab.sim.storage import MEASURES, STATE

__all__ = ["CONTACT_MODELS", "Measures", "Rollout", "Simulator", "State"]

CONTACT_MODELS = ("soft", "hard")

STAMP_MAX = 2**31 - 2**20


@dataclass(frozen=True)
class State:
    """Particles and manipulators of all environments, float64.

    Attributes:
        x: Particle positions [domain units], shape [batch, particle, 3].
        v: Particle velocities, shape [batch, particle, 3].
        C: APIC velocity gradients, shape [batch, particle, 3, 3].
        F: Deformation gradients, shape [batch, particle, 3, 3].
        poses: Position (3), quaternion w, x, y, z (4) and gap (1), shape [batch, manipulator, 8].
    """

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    F: np.ndarray
    poses: np.ndarray


@dataclass(frozen=True)
class Measures:
    """What a state is judged by.

    Attributes:
        terms: Unweighted loss terms (density, SDF, contact), shape [batch, 3]; SDF and contact are 0 where
            their weight is.
        iou: Soft IoU of the mass tensor and the target, as :func:`plab.objective.soft_iou`, shape [batch];
            NaN before :meth:`Simulator.set_target`.
    """

    terms: np.ndarray
    iou: np.ndarray


@dataclass(frozen=True)
class Rollout:
    """What a rollout of T environment steps gives.

    Attributes:
        initial_terms: Unweighted loss terms (density, SDF, contact) of the initial state, shape [batch, 3].
        step_terms: The same after each environment step, shape [batch, T, 3].
        initial_iou: Soft IoU of the initial mass tensor and the target, shape [batch].
        step_iou: The same after each environment step, shape [batch, T].
        gradient: Gradient of the weighted trajectory loss (sum over steps) with respect to the actions, shape
            [batch, T, action], or None if it was not asked for.
    """

    initial_terms: np.ndarray
    step_terms: np.ndarray
    initial_iou: np.ndarray
    step_iou: np.ndarray
    gradient: np.ndarray | None


class Simulator:
    """Differentiable elastoplastic MLS-MPM for a batch of environments.

    All environments share the numbers of particles and manipulators, the manipulators' shapes, grid and time
    step; positions, sizes, material and targets may differ. One process has one device and precision at a
    time.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        *,
        precision: str = "float32",
        device: str = "cpu",
        memory_mb: float = 4000.0,
        threads: int | None = None,
        particles: Sequence[np.ndarray] | None = None,
        skips: Skips = Skips(),  # noqa: B008 - frozen
    ) -> None:
        """Build the simulator and put all environments into their initial states.

        Args:
            scenes: One scene per environment.
            precision: ``float32`` or ``float64``.
            device: ``cpu`` or ``cuda``.
            memory_mb: Budget for all fields and arrays with a gradient [MB]; fewer states are kept and more
                recomputed to stay in it.
            threads: CPU threads; all that the process may use if None. Results do not depend on it.
            particles: Initial positions per environment, each [particle, 3]; sampled from the scene if None.
            skips: What is not computed where it is not needed; for measuring what that saves.

        Raises:
            SceneError: If a scene cannot be simulated or the scenes do not fit together.
            DeviceError: If CUDA was asked for and is not there.
        """
        if not scenes:
            raise SceneError("a simulator needs at least one scene")
        for scene in scenes:
            scene.validate()
        _require_alike(scenes)
        self.scenes = tuple(scenes)
        self.memory_mb = memory_mb
        self._runtime = start_runtime(device, precision, threads)
        self._skips = skips
        self._engine = _engine_class(device)(self.scenes, self._runtime, skips)
        register_user(self)
        self._numpy_real = np.float32 if precision == "float32" else np.float64
        self._stamp = 0
        self._history: ti.Ndarray | None = None
        self._checkpoints: ti.Ndarray | None = None
        self._bar: ti.Ndarray | None = None
        self._current = self._state_array(1)
        self._initial = self._state_array(1)
        self._scratch_terms = ti.ndarray(ti.f64, shape=MEASURES * self.batch)
        self._observed: dict[int, tuple[ti.Ndarray, ti.Ndarray]] = {}
        self._target_scale = np.full((2, self.batch), np.nan)
        self._pose = ti.ndarray(ti.f64, shape=max(1, self.batch * self.manipulator_count * 8))
        positions = [sample_particles(s) for s in scenes] if particles is None else list(particles)
        self._order = np.stack([curve_order(x, scenes[0].grid_size) for x in positions])
        self._initial_poses = np.array(
            [[[*m.position, *_unit(m.rotation), m.gap] for m in s.manipulators] for s in scenes],
            dtype=np.float64,
        ).reshape(self.batch, self.manipulator_count, 8)
        self._initial.from_numpy(self._pack(_rest_state(np.stack(positions), self._initial_poses)))
        self.set_contact("soft")
        self.set_loss_weights(10.0, 10.0, 1.0)
        self.reset()

    # -- sizes --------------------------------------------------------------------------------------

    @property
    def device(self) -> str:
        """``cpu`` or ``cuda``."""
        return self._runtime.device

    @property
    def precision(self) -> str:
        """``float32`` or ``float64``."""
        return self._runtime.precision

    @property
    def batch(self) -> int:
        """Number of environments."""
        return len(self.scenes)

    @property
    def particle_count(self) -> int:
        """Particles per environment."""
        return self.scenes[0].particle_count

    @property
    def manipulator_count(self) -> int:
        """Manipulators per environment, static ones included."""
        return len(self.scenes[0].manipulators)

    @property
    def action_dim(self) -> int:
        """Action components per environment step."""
        return self.scenes[0].action_dim

    @property
    def grid_size(self) -> int:
        """Grid nodes per axis."""
        return self.scenes[0].grid_size

    @property
    def substeps(self) -> int:
        """Substeps per environment step."""
        return self.scenes[0].substeps

    # -- settings -----------------------------------------------------------------------------------

    def set_contact(self, model: str, softness: float = 666.0) -> None:
        """Choose the contact model; nothing is compiled anew.

        Args:
            model: ``soft`` (strength exp(-softness d) outside the surface) or ``hard``.
            softness: Decay rate of the soft model [1 / domain unit].
        """
        if model not in CONTACT_MODELS:
            raise ValueError(f"contact '{model}' is not one of {', '.join(CONTACT_MODELS)}")
        if model == "soft" and not softness > 0:
            raise ValueError(f"softness {softness:g} must be positive")
        self._engine.alpha[None] = softness if model == "soft" else 0.0

    def set_loss_weights(self, density: float, sdf: float, contact: float) -> None:
        """Set the weights of the three loss terms in the trajectory loss and its gradient.

        The SDF and the contact term are not computed where their weight is 0: they are given as 0 then.
        """
        self._engine.loss_weights[None] = [density, sdf, contact]

    def set_target(self, mass: np.ndarray, sdf: np.ndarray) -> None:
        """Set the targets of all environments.

        Args:
            mass: Target mass tensors, shape [batch, n, n, n].
            sdf: Distance of each node to the target [domain units], same shape.

        Raises:
            ValueError: If a shape is wrong.
        """
        expected = (self.batch, self.grid_size, self.grid_size, self.grid_size)
        for name, value in (("mass", mass), ("sdf", sdf)):
            if np.shape(value) != expected:
                raise ValueError(f"target {name} has shape {np.shape(value)}, not {expected}")
        self._engine.target.from_numpy(np.asarray(mass, self._numpy_real).reshape(-1))
        self._engine.target_sdf.from_numpy(np.asarray(sdf, self._numpy_real).reshape(-1))
        sums = np.asarray(mass, self._numpy_real).astype(np.float64).sum(axis=(1, 2, 3))
        self._engine.target_sum.from_numpy(sums)
        peaks = np.asarray(mass, self._numpy_real).astype(np.float64).max(axis=(1, 2, 3))
        self._target_scale = np.stack([sums, peaks])

    # -- forward ------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Put all environments into their initial states."""
        self._require_runtime()
        self._engine.copy_slot(self._initial, 0, self._current, 0)
        self._place(self._initial_poses)
        self._engine.fault.fill(0)
        self._engine.touched.fill(0)

    def step(self, actions: np.ndarray) -> None:
        """Advance all environments by one environment step, without keeping history.

        Args:
            actions: Actions, shape [batch, action]; clipped to [-1, 1].

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If the state stops being finite.
        """
        self._require_runtime()
        array = self._action_array(np.asarray(actions, np.float64)[:, None])
        self._engine.step(self._current, self._pose, array, 0, 0, 0, 0, 0, self._take_stamps(self.substeps))
        self._check_fault()

    def rollout(self, actions: np.ndarray, gradient: bool = True) -> Rollout:
        """Run environment steps from the initial state, and differentiate the trajectory loss.

        Args:
            actions: Actions, shape [batch, T, action]; clipped to [-1, 1].
            gradient: Whether to compute the gradient.

        Returns:
            Loss terms per step and the gradient; the simulator is left in the final state.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If state, loss or gradient stop being finite.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        self.reset()
        array = self._action_array(np.asarray(actions, np.float64))
        steps = np.shape(actions)[1]
        plan = self._plan(steps) if gradient or not self._skips.history else None
        poses = ti.ndarray(ti.f64, shape=max(1, (steps + 1) * self.batch * self.manipulator_count * 8))
        whole = np.zeros((steps + 1, self.batch, self.manipulator_count, 8))
        whole[0] = self._initial_poses
        poses.from_numpy(np.resize(whole.reshape(-1), poses.shape))
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * self.batch * MEASURES)
        self._losses(self._current, 0, terms, 0)
        self._run_forward(array, poses, terms, steps, plan)
        values = terms.to_numpy().reshape(steps + 1, self.batch, MEASURES)
        self._check_fault()
        self._check_terms(values)
        actions_bar = self._run_backward(array, poses, steps, plan) if gradient else None
        self._place(poses.to_numpy()[: whole.size].reshape(whole.shape)[-1])
        judged = self._measures(values)
        step_terms, step_iou = judged.terms[1:].transpose(1, 0, 2), judged.iou[1:].T
        return Rollout(judged.terms[0], step_terms, judged.iou[0], step_iou, actions_bar)

    def measure(self) -> Measures:
        """Loss terms and soft IoU of the current state."""
        self._require_runtime()
        self._losses(self._current, 0, self._scratch_terms, 0)
        return self._measures(self._scratch_terms.to_numpy().reshape(self.batch, MEASURES))

    def losses(self) -> np.ndarray:
        """Unweighted loss terms (density, SDF, contact) of the current state, shape [batch, 3]."""
        return self.measure().terms

    def mass_tensor(self) -> np.ndarray:
        """Mass at the grid nodes in the current state, shape [batch, n, n, n], float64."""
        self._require_runtime()
        self._losses(self._current, 0, self._scratch_terms, 0)
        n = self.grid_size
        out = np.zeros(self.batch * n**3, self._numpy_real)
        self._engine.export_mass(out)
        return out.reshape(self.batch, n, n, n).astype(np.float64)

    # -- state --------------------------------------------------------------------------------------

    def state(self) -> State:
        """The current state, particles in the order in which they were given."""
        poses = self.poses()
        return self._unpack(self._current.to_numpy(), poses)

    def observe(self, stride: int) -> np.ndarray:
        """Position and velocity of every ``stride``-th particle, in the order in which they were given.

        Only these are copied from the device.

        Args:
            stride: Distance of the observed particles' numbers, at least 1.

        Returns:
            Position (3) and velocity (3), shape [batch, observed, 6], float32 or float64 like the simulation.
        """
        self._require_runtime()
        if stride not in self._observed:
            self._observed[stride] = self._allocate_observation(stride)
        places, out = self._observed[stride]
        count = places.shape[0] // self.batch
        self._engine.observe(self._current, places, count, out)
        return out.to_numpy().reshape(self.batch, count, 6)

    def poses(self) -> np.ndarray:
        """Poses of the manipulators, float64, shape [batch, manipulator, 8]; see :class:`State`."""
        self._require_runtime()
        return self._pose.to_numpy()[: self._initial_poses.size].reshape(self._initial_poses.shape)

    def set_state(self, state: State) -> None:
        """Replace the current state.

        Args:
            state: Shapes as in :class:`State`.

        Raises:
            ValueError: If a shape is wrong.
        """
        self._require_runtime()
        expected = (self.batch, self.particle_count)
        for name, tail in (("x", (3,)), ("v", (3,)), ("C", (3, 3)), ("F", (3, 3))):
            if np.shape(getattr(state, name)) != (*expected, *tail):
                raise ValueError(
                    f"{name} has shape {np.shape(getattr(state, name))}, not {(*expected, *tail)}"
                )
        if np.shape(state.poses) != self._initial_poses.shape:
            raise ValueError(f"poses have shape {np.shape(state.poses)}, not {self._initial_poses.shape}")
        self._current.from_numpy(self._pack(state))
        self._place(np.asarray(state.poses, np.float64))
        self._engine.fault.fill(0)

    def set_initial_state(self, state: State) -> None:
        """Replace the state from which :meth:`reset` and :meth:`rollout` start; shapes as in
        :class:`State`."""
        self.set_state(state)
        self._initial_poses = np.array(state.poses, np.float64)
        self._engine.copy_slot(self._current, 0, self._initial, 0)

    # -- internals ----------------------------------------------------------------------------------

    def _measures(self, values: np.ndarray) -> Measures:
        """Loss terms and IoU from the kernels' measures, shape [..., batch, 5]."""
        overlap, peak = values[..., 3], values[..., 4]
        target_sum, target_peak = self._target_scale
        total = self.scenes[0].particle_mass * self.particle_count
        # Without a target there is no IoU: NaN.
        with np.errstate(invalid="ignore", divide="ignore"):
            both = overlap / (peak * target_peak)
            iou = both / (total / peak + target_sum / target_peak - both)
        return Measures(values[..., :3], iou)

    def _allocate_observation(self, stride: int) -> tuple[ti.Ndarray, ti.Ndarray]:
        """Places of the observed particles in the tiles' order, and room for what is observed of them."""
        where = np.argsort(self._order, axis=1)[:, ::stride]
        places = ti.ndarray(ti.i32, shape=where.size)
        places.from_numpy(where.astype(np.int32).reshape(-1))
        return places, ti.ndarray(self._runtime.real, shape=where.size * 6)

    def _state_array(self, slots: int) -> ti.Ndarray:
        engine = self._engine
        return ti.ndarray(engine.lane_type, shape=slots * self.batch * engine.tiles * STATE)

    def memory_bytes(self) -> int:
        """Bytes of all fields and arrays that the simulator holds now, on its device; without Taichi itself,
        its compiled kernels and what is on the way to or from the host."""
        return held_bytes((*vars(self._engine).values(), *vars(self).values()))

    def _slot_bytes(self) -> int:
        engine = self._engine
        return self.batch * engine.tiles * STATE * engine.lanes * np.dtype(self._numpy_real).itemsize

    def _plan(self, steps: int) -> int:
        """Environment steps per segment whose every state is kept, so that all fits into the memory
        budget."""
        budget = self.memory_mb * 1e6
        self._engine.allocate_adjoint()
        fixed = held_bytes(vars(self._engine).values()) + held_bytes((self._current, self._initial))

        def cost(length: int) -> int:
            segments = -(-steps // length)
            slots = length * self.substeps + 2 + (segments if segments > 1 else 0)
            return fixed + slots * self._slot_bytes()

        # Taichi counts the entries of an array in 32 bits.
        slots = (2**31 - 1) // (self._slot_bytes() // np.dtype(self._numpy_real).itemsize)
        fitting = [
            length
            for length in range(1, steps + 1)
            if cost(length) <= budget and max(length * self.substeps + 1, -(-steps // length)) <= slots
        ]
        if not fitting:
            need = math.ceil(min(cost(length) for length in range(1, steps + 1)) / 1e6)
            raise MemoryError(
                f"the gradient of {steps} steps needs at least {need} MB, but memory_mb is "
                f"{self.memory_mb:g}: "
                f"set sim.memory_mb={need} or more"
            )
        # Fewest recomputed steps first: as few segments as possible, of even length.
        segments = -(-steps // max(fitting))
        return -(-steps // segments)

    def _allocate_gradient(self, length: int, segments: int) -> None:
        slots = length * self.substeps + 1
        size = slots * self._current.shape[0]
        if self._history is None or self._history.shape[0] < size:
            self._history = None
            self._history = self._state_array(slots)
        if segments > 1 and (
            self._checkpoints is None or self._checkpoints.shape[0] < segments * self._current.shape[0]
        ):
            self._checkpoints = None
            self._checkpoints = self._state_array(segments)
        if self._bar is None:
            self._bar = self._state_array(1)

    def _run_forward(self, actions, poses, terms, steps: int, length: int | None) -> None:
        if length is None:
            for t in range(steps):
                self._advance(self._current, 0, 0, t, actions, poses)
                self._losses(self._current, 0, terms, (t + 1) * self.batch * MEASURES)
            return
        segments = -(-steps // length)
        self._allocate_gradient(length, segments)
        for k in range(segments):
            if segments > 1:
                self._engine.copy_slot(self._current, 0, self._checkpoints, k)
            last = k == segments - 1
            if last:
                self._engine.copy_slot(self._current, 0, self._history, 0)
            for t in range(k * length, min(steps, (k + 1) * length)):
                if last:
                    slot = (t - k * length) * self.substeps
                    self._advance(self._history, slot, 1, t, actions, poses)
                    self._losses(self._history, slot + self.substeps, terms, (t + 1) * self.batch * MEASURES)
                else:
                    self._advance(self._current, 0, 0, t, actions, poses)
                    self._losses(self._current, 0, terms, (t + 1) * self.batch * MEASURES)
        end = (steps - (segments - 1) * length) * self.substeps
        self._engine.copy_slot(self._history, end, self._current, 0)

    def _run_backward(self, actions, poses, steps: int, length: int) -> np.ndarray:
        segments = -(-steps // length)
        actions_bar = ti.ndarray(ti.f64, shape=actions.shape)
        actions_bar.fill(0.0)
        self._bar.fill(0.0)
        self._engine.pose_bar.fill(0.0)
        self._engine.frame_bar.fill(0.0)
        contact_free = self._steps_before_contact(steps)
        for k in reversed(range(segments)):
            stop = min(steps, (k + 1) * length)
            if k < segments - 1:
                self._engine.copy_slot(self._checkpoints, k, self._history, 0)
                for t in range(k * length, stop):
                    self._advance(self._history, (t - k * length) * self.substeps, 1, t, actions, poses)
            for t in reversed(range(k * length, stop)):
                slot = (t - k * length) * self.substeps
                self._engine.step_adjoint(
                    self._history,
                    self._bar,
                    poses,
                    actions,
                    actions_bar,
                    self._scratch_terms,
                    slot,
                    t,
                    self._take_stamps(self.substeps + 1),
                    int(t >= contact_free),
                )
        gradient = actions_bar.to_numpy()[: steps * self.batch * self.action_dim]
        gradient = gradient.reshape(steps, self.batch, self.action_dim).transpose(1, 0, 2)
        for t in reversed(range(steps)):
            bad = np.flatnonzero(~np.isfinite(gradient[:, t]).all(axis=1))
            if bad.size:
                raise SimulationError(
                    f"the gradient is not finite: environment {bad[0]}, environment step {t + 1}"
                )
        return gradient

    def _steps_before_contact(self, steps: int) -> int:
        """Environment steps of the rollout just done before a manipulator touches any environment's body."""
        if not self._skips.adjoints:
            return 0
        touched = self._engine.touched.to_numpy() != 0
        return int(np.where(touched, self._engine.untouched_step.to_numpy(), steps).min())

    def _advance(self, state, slot: int, stride: int, t: int, actions, poses) -> None:
        self._engine.step(state, poses, actions, slot, stride, t, t, t + 1, self._take_stamps(self.substeps))

    def _losses(self, state, slot: int, terms, at: int) -> None:
        self._engine.losses(state, slot, terms, at, self._take_stamps(1))

    def _place(self, poses: np.ndarray) -> None:
        if self.manipulator_count:
            self._pose.from_numpy(np.ascontiguousarray(poses).reshape(-1))
            self._engine.place(self._pose, 0)

    def _take_stamps(self, count: int) -> int:
        """The first of ``count`` fresh stamps."""
        if self._stamp + count >= STAMP_MAX:
            self._engine.block_stamp.fill(0)
            self._engine.mark_stamp.fill(0)
            self._stamp = 0
        first = self._stamp + 1
        self._stamp += count
        return first

    def _action_array(self, actions: np.ndarray) -> ti.Ndarray:
        expected = (self.batch, actions.shape[1] if actions.ndim == 3 else "T", self.action_dim)
        if actions.shape != expected:
            raise ValueError(f"actions have shape {actions.shape}, not {expected} (batch, steps, components)")
        if not np.isfinite(actions).all():
            raise ValueError("actions contain NaN or infinity")
        flat = np.ascontiguousarray(actions.transpose(1, 0, 2)).reshape(-1)
        array = ti.ndarray(ti.f64, shape=max(1, flat.size))
        if flat.size:
            array.from_numpy(flat)
        return array

    def _check_fault(self) -> None:
        faults = self._engine.fault.to_numpy()
        bad = np.flatnonzero(faults)
        if bad.size:
            step, substep = divmod(int(faults[bad[0]]) - 1, self.substeps)
            raise SimulationError(
                f"the state is not finite or a particle crosses the domain in one substep: "
                f"environment {bad[0]}, "
                f"environment step {step + 1}, substep {substep + 1}"
            )

    def _check_terms(self, terms: np.ndarray) -> None:
        bad = np.argwhere(~np.isfinite(terms))
        if bad.size:
            when = f"after environment step {bad[0][0]}" if bad[0][0] else "at the start"
            raise SimulationError(f"the loss is not finite: environment {bad[0][1]}, {when}")

    def _require_runtime(self) -> None:
        if not is_current(self._runtime):
            raise RuntimeError(
                "this simulator's memory is gone: Taichi was started anew with another device, precision or "
                "number of "
                "threads; build the simulator again"
            )

    def _pack(self, state: State) -> np.ndarray:
        """User arrays to tiles along the curve, the last tile padded with particles at rest."""
        engine = self._engine
        b, n = self.batch, self.particle_count
        flat = np.zeros((b, engine.tiles * engine.lanes, STATE), self._numpy_real)
        flat[:, :, [15, 19, 23]] = 1.0
        parts = (state.x, state.v, np.reshape(state.C, (b, n, 9)), np.reshape(state.F, (b, n, 9)))
        values = np.concatenate(parts, axis=2)
        flat[:, :n] = np.take_along_axis(values, self._order[:, :, None], axis=1)
        tiles = flat.reshape(b, engine.tiles, engine.lanes, STATE).transpose(0, 1, 3, 2)
        return np.ascontiguousarray(tiles).reshape(-1, engine.lanes)

    def _unpack(self, tiles: np.ndarray, poses: np.ndarray) -> State:
        engine = self._engine
        b, n = self.batch, self.particle_count
        flat = (
            tiles.reshape(b, engine.tiles, STATE, engine.lanes)
            .transpose(0, 1, 3, 2)
            .reshape(b, -1, STATE)[:, :n]
        )
        values = np.empty((b, n, STATE))
        np.put_along_axis(values, self._order[:, :, None], flat.astype(np.float64), axis=1)
        shape = (b, n, 3, 3)
        return State(
            values[..., 0:3],
            values[..., 3:6],
            values[..., 6:15].reshape(shape),
            values[..., 15:24].reshape(shape),
            poses,
        )


def _engine_class(device: str) -> type:
    if device == "cuda":
        from plab.sim.cuda_engine import CudaEngine

        return CudaEngine
    return CpuEngine


def _unit(rotation: Sequence[float]) -> list[float]:
    """A quaternion of length 1; YAML files round theirs."""
    q = np.asarray(rotation, float)
    return list(q / np.linalg.norm(q))


def _rest_state(x: np.ndarray, poses: np.ndarray) -> State:
    shape = (*x.shape, 3)
    identity = np.broadcast_to(np.eye(3), shape)
    return State(x, np.zeros_like(x), np.zeros(shape), identity, poses)


def _require_alike(scenes: Sequence[Scene]) -> None:
    first = scenes[0]
    for number, scene in enumerate(scenes[1:], start=1):
        for name in ("particle_count", "grid_size", "dt", "substeps"):
            if getattr(scene, name) != getattr(first, name):
                raise SceneError(
                    f"scenes of one batch need the same {name}: scene 0 has {getattr(first, name)}, "
                    f"scene {number} has {getattr(scene, name)}"
                )
        if [m.shape for m in scene.manipulators] != [m.shape for m in first.manipulators]:
            raise SceneError(
                f"scenes of one batch need the same manipulators; scene {number} differs from scene 0"
            )
