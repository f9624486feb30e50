"""The simulator: a batch of environments of one kind of scene, forward and differentiated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from plab.scene import Scene, SceneError, sample_particles
from plab.sim.batch import initial_poses, require_alike, with_material
from plab.sim.engine import CpuEngine
from plab.sim.failures import broken_gradients, broken_states, broken_terms, require_none
from plab.sim.judging import Judge
from plab.sim.memory import held_bytes
from plab.sim.parameters import parameter_gradient
from plab.sim.particles import Particles
from plab.sim.runtime import is_current, register_user, start_runtime
from plab.sim.skips import Skips
from plab.sim.state import Measures, Rollout, State, rest_state
from plab.sim.storage import MEASURES
from plab.sim.tape import Tape
from plab.sim.tensors import action_array, numbers_of, on_device, output_for, step_actions

if TYPE_CHECKING:
    import torch

__all__ = ["CONTACT_MODELS", "Simulator"]

CONTACT_MODELS = ("soft", "hard")


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
        full_gradient: bool = False,
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
            full_gradient: Whether a rollout's gradient includes those with respect to the initial state
                (:meth:`state_gradient`) and the material (:meth:`material_gradient`).
            skips: What is not computed where it is not needed; for measuring what that saves.

        Raises:
            SceneError: If a scene cannot be simulated or the scenes do not fit together.
            DeviceError: If CUDA was asked for and is not there.
        """
        if not scenes:
            raise SceneError("a simulator needs at least one scene")
        for scene in scenes:
            scene.validate()
        require_alike(scenes)
        self.scenes = tuple(scenes)
        self.memory_mb = memory_mb
        self._runtime = start_runtime(device, precision, threads)
        self._skips = skips
        self._engine = _engine_class(device)(self.scenes, self._runtime, skips, full_gradient)
        register_user(self)
        self._numpy_real = np.float32 if precision == "float32" else np.float64
        self._scratch_terms = ti.ndarray(ti.f64, shape=MEASURES * self.batch)
        self._observed: dict[int, ti.Ndarray] = {}
        self._judge = Judge(self.scenes)
        self._pose = ti.ndarray(ti.f64, shape=max(1, self.batch * self.manipulator_count * 8))
        self._particles = Particles(self._engine, self._numpy_real)
        self._tape = Tape(self._particles)
        self._initial = self._particles.array(1)
        self._start_from(particles)
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

    def memory_bytes(self) -> int:
        """Bytes of all fields and arrays that the simulator holds now, on its device; without Taichi itself,
        its compiled kernels and what is on the way to or from the host."""
        return held_bytes(self, self._engine, self._particles, self._particles.order, self._tape)

    # -- settings -----------------------------------------------------------------------------------

    def set_contact(self, model: str | Sequence[str], softness: float | Sequence[float] = 666.0) -> None:
        """Choose the contact model; nothing is compiled anew.

        Args:
            model: ``soft`` (strength exp(-softness d) outside the surface) or ``hard``; one for all
                environments, or one for each.
            softness: Decay rate of the soft model [1 / domain unit]; one for all, or one for each.
        """
        models = np.broadcast_to(model, self.batch)
        decay = np.broadcast_to(np.asarray(softness, float), self.batch)
        for name, rate in zip(models, decay, strict=True):
            if name not in CONTACT_MODELS:
                raise ValueError(f"contact '{name}' is not one of {', '.join(CONTACT_MODELS)}")
            if name == "soft" and not rate > 0:
                raise ValueError(f"softness {rate:g} must be positive")
        self._engine.alpha.from_numpy(np.where(models == "soft", decay, 0.0).astype(self._numpy_real))

    def set_loss_weights(self, density: float, sdf: float, contact: float) -> None:
        """Set the weights of the three loss terms in the trajectory loss and its gradient.

        The SDF and the contact term are not computed where their weight is 0: they are given as 0 then.
        """
        self._engine.loss_weights[None] = [density, sdf, contact]

    def set_scenes(self, scenes: Sequence[Scene], *, particles: Sequence[np.ndarray] | None = None) -> None:
        """Replace all scenes by others of the same kind and reset; nothing is compiled anew.

        Contact model, weights and targets stay.

        Args:
            scenes: One scene per environment.
            particles: Initial positions per environment, each [particle, 3]; sampled from the scene if None.

        Raises:
            SceneError: If a scene cannot be simulated or is of another kind; nothing is changed then.
        """
        self._require_runtime()
        if len(scenes) != self.batch:
            raise SceneError(f"{len(scenes)} scenes for a simulator of {self.batch} environments")
        for scene in scenes:
            scene.validate()
        require_alike([self.scenes[0], *scenes])
        self._require_compiled(scenes)
        self.scenes = tuple(scenes)
        self._engine.fill_parameters(scenes)
        self._start_from(particles)
        self.reset()

    def set_material(
        self,
        youngs_modulus: ArrayLike | None = None,
        poisson_ratio: ArrayLike | None = None,
        yield_stress: ArrayLike | None = None,
    ) -> None:
        """Change the material; nothing is compiled anew.

        Args:
            youngs_modulus: Young's modulus, one for all environments or shape [batch]; as it is if None.
            poisson_ratio: Poisson ratio, likewise.
            yield_stress: von Mises yield stress, likewise.

        Raises:
            SceneError: If a scene could not be simulated with it; nothing is changed then.
        """
        scenes = with_material(self.scenes, youngs_modulus, poisson_ratio, yield_stress)
        for scene in scenes:
            scene.validate()
        self._require_compiled(scenes)
        self.scenes = scenes
        self._engine.fill_material(scenes)

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
        self._judge.set_target(np.asarray(mass, self._numpy_real).astype(np.float64))
        self._engine.target_sum.from_numpy(self._judge.target_sum)

    # -- forward ------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Put all environments into their initial states."""
        self._require_runtime()
        self._engine.copy_slot(self._initial, 0, self._particles.current, 0)
        self._particles.order.reset()
        self._place(self._initial_poses)
        self._engine.fault.fill(0)
        self._checked = True
        self._engine.touched.fill(0)

    def step(self, actions: np.ndarray | torch.Tensor, *, check: bool = True) -> None:
        """Advance all environments by one environment step, without keeping history.

        Args:
            actions: Actions, shape [batch, action]; clipped to [-1, 1]. A CUDA tensor is taken as it is.
            check: Whether to wait for the step and look for faults. If not, the next :meth:`measure` does.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If the state stops being finite and ``check`` is set.
        """
        self._require_runtime()
        array = step_actions(actions, self.batch, self.action_dim, self.device)
        self._particles.step(self._pose, array)
        self._checked = check
        if check:
            require_none(broken_states(self._engine.fault.to_numpy(), self.substeps))

    def rollout(
        self, actions: np.ndarray | torch.Tensor, gradient: bool = True, *, strict: bool = True
    ) -> Rollout:
        """Run environment steps from the initial state, and differentiate the trajectory loss.

        Args:
            actions: Actions, shape [batch, T, action]; clipped to [-1, 1]. Given a CUDA tensor, the gradient
                is one too, of its type.
            gradient: Whether to compute the gradient.
            strict: Whether an environment that breaks off is an error, instead of an entry in ``failures``.

        Returns:
            Loss terms per step and the gradient; the simulator is left in the final state.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If state, loss or gradient stop being finite and ``strict`` is set.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        self.reset()
        array = action_array(actions, self.batch, self.action_dim, self.device)
        steps = actions.shape[1] if on_device(actions) else np.shape(actions)[1]
        kept = gradient or not self._skips.history
        plan = self._tape.plan(steps, self.memory_mb) if kept else None
        poses = ti.ndarray(ti.f64, shape=max(1, (steps + 1) * self.batch * self.manipulator_count * 8))
        whole = np.zeros((steps + 1, self.batch, self.manipulator_count, 8))
        whole[0] = self._initial_poses
        poses.from_numpy(np.resize(whole.reshape(-1), poses.shape))
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * self.batch * MEASURES)
        self._particles.losses(terms, 0)
        self._tape.forward(array, poses, None if gradient else terms, steps, plan)
        bars = None
        if gradient:
            bars = self._tape.backward(array, poses, terms, steps, self._steps_before_contact(steps))
        values = terms.to_numpy().reshape(steps + 1, self.batch, MEASURES)
        failures = broken_terms(values) | broken_states(values[-1, :, -1], self.substeps)
        if strict:
            require_none(failures)
        actions_bar = None
        if bars is not None:
            actions_bar = numbers_of(bars, (steps, self.batch, self.action_dim), actions).swapaxes(0, 1)
            failures = broken_gradients(actions_bar) | failures
            if strict:
                require_none(failures)
        self._place(poses.to_numpy()[: whole.size].reshape(whole.shape)[-1])
        judged = self._judge.measures(values)
        step_terms, step_iou = judged.terms[1:].transpose(1, 0, 2), judged.iou[1:].T
        return Rollout(judged.terms[0], step_terms, judged.iou[0], step_iou, actions_bar, failures)

    def state_gradient(self) -> State:
        """Gradient of the last :meth:`rollout`'s loss with respect to the state it started from.

        The backward pass ends with it; asking for it copies it from the device. The gradient with respect to
        a quaternion is that of the rotation matrix's polynomial, to be projected on its tangent space.

        Raises:
            RuntimeError: If the simulator was built without ``full_gradient=True``, or there was no rollout
                with a gradient.
        """
        self._require_gradient()
        assert self._tape.bar is not None
        poses = self._engine.pose_bar.to_numpy().reshape(self.batch, -1, 8)[:, : self.manipulator_count]
        return self._particles.unpack(self._tape.bar.to_numpy(), poses, self._particles.order.initial)

    def material_gradient(self) -> np.ndarray:
        """Gradient of the last :meth:`rollout`'s loss with respect to the material.

        Returns:
            Derivatives with respect to Young's modulus, Poisson ratio and yield stress, shape [batch, 3].

        Raises:
            RuntimeError: If the simulator was built without ``full_gradient=True``, or there was no
                rollout with a gradient.
        """
        self._require_gradient()
        bars = self._engine.material_bar.to_numpy().reshape(self.batch, -1, 3).sum(axis=1)
        return np.stack([parameter_gradient(s, bar) for s, bar in zip(self.scenes, bars, strict=True)])

    def measure(self, like: torch.Tensor | None = None) -> Measures:
        """Loss terms and soft IoU of the current state; CUDA tensors if ``like`` is one, of its type.

        Raises:
            SimulationError: If the last step, which was not to look for faults, broke the state.
        """
        self._require_runtime()
        if on_device(like):
            values = output_for(lambda out: self._particles.losses(out, 0), self.batch * MEASURES, True, like)
            values = values.reshape(self.batch, MEASURES)
        else:
            self._particles.losses(self._scratch_terms, 0)
            values = self._scratch_terms.to_numpy().reshape(self.batch, MEASURES)
        checked, self._checked = self._checked, True
        if not checked:
            require_none(broken_states(values[:, -1], self.substeps))
        return self._judge.measures(values)

    def losses(self) -> np.ndarray:
        """Unweighted loss terms (density, SDF, contact) of the current state, shape [batch, 3]."""
        return self.measure().terms

    def mass_tensor(self) -> np.ndarray:
        """Mass at the grid nodes in the current state, shape [batch, n, n, n], float64."""
        self._require_runtime()
        self._particles.losses(self._scratch_terms, 0)
        n = self.grid_size
        out = np.zeros(self.batch * n**3, self._numpy_real)
        self._engine.export_mass(out)
        return out.reshape(self.batch, n, n, n).astype(np.float64)

    # -- state --------------------------------------------------------------------------------------

    def state(self) -> State:
        """The current state, particles in the order in which they were given."""
        poses = cast(np.ndarray, self.poses())
        return self._particles.unpack(self._particles.current.to_numpy(), poses)

    def observe(self, stride: int, like: torch.Tensor | None = None) -> np.ndarray | torch.Tensor:
        """Position and velocity of every ``stride``-th particle, in the order in which they were given.

        Only these are copied from the device.

        Args:
            stride: Distance of the observed particles' numbers, at least 1.
            like: Given a CUDA tensor, the result is one too, of its type, and nothing is copied to the host.

        Returns:
            Position (3) and velocity (3), shape [batch, observed, 6], float32 or float64 like the simulation.
        """
        self._require_runtime()
        count = -(-self.particle_count // stride)
        size = self.batch * count * 6

        def fill(out: ti.Ndarray | torch.Tensor) -> None:
            self._engine.observe(self._particles.current, self._particles.order.numbers, stride, out)

        if on_device(like):
            return output_for(fill, size, self.precision == "float64", like).reshape(self.batch, count, 6)
        if stride not in self._observed:
            self._observed[stride] = ti.ndarray(self._runtime.real, shape=size)
        fill(self._observed[stride])
        return self._observed[stride].to_numpy().reshape(self.batch, count, 6)

    def poses(self, like: torch.Tensor | None = None) -> np.ndarray | torch.Tensor:
        """Poses of the manipulators, float64, shape [batch, manipulator, 8]; see :class:`State`. A CUDA
        tensor if ``like`` is one, of its type."""
        self._require_runtime()
        return numbers_of(self._pose, self._initial_poses.shape, like)

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
        self._particles.current.from_numpy(self._particles.pack(state))
        self._particles.order.reset()
        self._place(np.asarray(state.poses, np.float64))
        self._engine.fault.fill(0)

    def set_initial_state(self, state: State) -> None:
        """Replace the state from which :meth:`reset` and :meth:`rollout` start; shapes as in
        :class:`State`."""
        self.set_state(state)
        self._initial_poses = np.array(state.poses, np.float64)
        self._engine.copy_slot(self._particles.current, 0, self._initial, 0)

    # -- internals ----------------------------------------------------------------------------------

    def _require_compiled(self, scenes: Sequence[Scene]) -> None:
        """Refuse scenes that need what was left out when the simulator was built."""
        for name in self._engine.left_out(scenes):
            raise SceneError(
                f"this simulator was built for scenes without {name}: build it with skips=Skips({name}=False)"
            )

    def _start_from(self, particles: Sequence[np.ndarray] | None) -> None:
        """Make the scenes' start the initial state."""
        positions = [sample_particles(s) for s in self.scenes] if particles is None else list(particles)
        self._particles.order.start_from(positions)
        self._initial_poses = initial_poses(self.scenes)
        start = rest_state(np.stack(positions), self._initial_poses)
        self._initial.from_numpy(self._particles.pack(start))

    def _steps_before_contact(self, steps: int) -> int:
        """Environment steps of the rollout just done before a manipulator touches any environment's body."""
        if self._engine.full_gradient or not self._skips.adjoints:
            return 0
        touched = self._engine.touched.to_numpy() != 0
        return int(np.where(touched, self._engine.untouched_step.to_numpy(), steps).min())

    def _place(self, poses: np.ndarray) -> None:
        if self.manipulator_count:
            self._pose.from_numpy(np.ascontiguousarray(poses).reshape(-1))
            self._engine.place(self._pose, 0)

    def _require_gradient(self) -> None:
        self._require_runtime()
        if not self._engine.full_gradient:
            raise RuntimeError("build the simulator with full_gradient=True for this gradient")
        if self._tape.bar is None:
            raise RuntimeError("there is no gradient yet: call rollout(actions, gradient=True) first")

    def _require_runtime(self) -> None:
        if not is_current(self._runtime):
            raise RuntimeError(
                "this simulator's memory is gone: Taichi was started anew with another device, precision or "
                "number of "
                "threads; build the simulator again"
            )


def _engine_class(device: str) -> type:
    if device == "cuda":
        from plab.sim.cuda_engine import CudaEngine

        return CudaEngine
    return CpuEngine
