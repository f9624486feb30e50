"""Batched simulator: settings, steps, rollouts and their gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import ArgumentError
from plab.plugins import torch
from plab.scenes import CONTACTS, Scene, SceneError, is_whole, sample_particles
from plab.sim.batch import (
    checked_positions,
    initial_poses,
    material_keys,
    once_each,
    require_alike,
    require_finite,
    with_material,
)
from plab.sim.compiler import ti
from plab.sim.cpu_engine import CpuEngine
from plab.sim.memory import held_bytes, require_memory
from plab.sim.particles import Particles
from plab.sim.runtime import own_fields, register_user, require_current, start_runtime
from plab.sim.state import (
    Measures,
    Rollout,
    State,
    broken_gradients,
    broken_states,
    broken_terms,
    require_none,
)
from plab.sim.storage import AT_V, WORLD
from plab.sim.tape import RecordedStates, Tape
from plab.sim.tensors import (
    copy_numbers,
    flat,
    from_host,
    kernel_actions,
    numbers_of,
    on_device,
    output_for,
    to_host,
)

if TYPE_CHECKING:
    from plab.kinematics.actions import JointActions, LinkMotion
    from plab.losses.term import Term


class Simulator:
    """Differentiable elastoplastic MLS-MPM for a batch of environments.

    All environments share the number of particles, the number and shapes of manipulators, the grid and the
    time step; positions, sizes, materials and targets may differ. A process uses one device and one precision
    at a time.

    Attributes:
        scenes: One scene per environment.
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``.
        memory_mb: Budget for all fields and arrays with a gradient [MB].
        batch: Number of environments.
        terms: Terms of the loss, in the order of :attr:`Measures.terms`.
        particle_count: Particles per environment.
        manipulator_count: Manipulators per environment, including static ones.
        action_dim: Action components per environment step.
        grid_size: Grid nodes per axis.
        substeps: Substeps per environment step.
        target_mass: Mass tensors of the targets, shape [batch, n, n, n], once they are set.
        changes: Number of changes of scenes, materials, targets and initial states so far.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        *,
        terms: Sequence[Term] = (),
        precision: str = "float32",
        device: str = "cpu",
        memory_mb: float = 4000.0,
        threads: int | None = None,
        particles: Sequence[np.ndarray] | None = None,
        full_gradient: bool = False,
        deterministic: bool = True,
        impulses: bool = False,
        _singular_values: bool = False,
    ) -> None:
        """Build the simulator and put all environments into their initial states.

        Args:
            scenes: One scene per environment.
            terms: Terms of the loss from :func:`plab.losses.make_terms`; terms of weight 0 are left out.
            precision: ``float32`` or ``float64``.
            device: ``cpu`` or ``cuda``.
            memory_mb: Memory budget for all fields and arrays with a gradient [MB]. If states do not fit,
                they are recomputed.
            threads: CPU threads; default: all available. Results do not depend on it.
            particles: Initial positions per environment, each [particle, 3]; sampled from the scene if None.
            full_gradient: Whether a rollout's gradient includes those with respect to the initial state
                (:meth:`state_gradient`), the material (:meth:`material_gradient`), gravity and friction
                (:meth:`world_gradient`).
            deterministic: Whether CUDA is bitwise reproducible, independent of the batch, see
                :mod:`plab.sim.cuda_sums`; False is faster. The CPU always is.
            impulses: Whether :meth:`step` sums the impulses on the manipulators (:meth:`impulses`).
            _singular_values: Whether to use singular values for all strains instead of series for small ones;
                for accuracy benchmarks.

        Raises:
            SceneError: If a scene cannot be simulated or the scenes cannot share a simulator.
            DeviceError: If CUDA is not available.
            ValueError: If device or precision are unknown, or terms belong to another simulator.
        """
        require_alike(scenes)
        self.scenes = tuple(scenes)
        self.device, self.precision, self.memory_mb = device, precision, memory_mb
        first, self.batch = self.scenes[0], len(self.scenes)
        self.particle_count, self.manipulator_count = first.particle_count, len(first.manipulators)
        self.action_dim, self.grid_size, self.substeps = first.action_dim, first.grid_size, first.substeps
        self._runtime = start_runtime(device, precision, threads)
        require_memory(self.scenes, precision, device)
        engine: Any = CpuEngine
        if device == "cuda":
            from plab.sim.cuda_engine import CudaEngine

            engine = CudaEngine
        self._engine = engine(self.scenes, self._runtime, full_gradient, deterministic, _singular_values)
        if impulses:
            self._engine.allocate_impulses()
        self._engine.attach(terms)
        own_fields(self._engine)
        self.terms: tuple[Term, ...] = tuple(term for term in self._engine.terms if term.weighted)
        self._engine.fill_parameters(self.scenes)
        register_user(self)
        self._scratch_terms = ti.ndarray(ti.f64, shape=self._engine.measures * self.batch)
        self._observed: dict[int, ti.Ndarray] = {}
        self._actions = ti.ndarray(ti.f64, shape=max(1, self.batch * self._engine.actions_per_step))
        self._pose = ti.ndarray(ti.f64, shape=max(1, self.batch * self.manipulator_count * 8))
        size = self.batch * self.manipulator_count * 3
        self._impulses = ti.ndarray(ti.f64, shape=max(1, size)) if impulses else None
        self._particles = Particles(self._engine)
        self._tape = Tape(self._particles)
        self._initial = self._particles.array(1)
        self._drive: LinkMotion | None = None
        self._joints: Any = None
        self._initial_joints: np.ndarray | None = None
        self._start_from(self._start_positions(self.scenes, particles))
        # Incremented by every change that affects the gradient of a rollout, and its value at the last one.
        self._version, self._differentiated = 0, -1
        self.changes = 0
        self.set_contact("soft")
        self.set_weights({term.name: term.weight for term in self.terms})
        self.reset()

    def memory_bytes(self) -> int:
        """Memory of all fields and arrays of the simulator on its device [bytes], without Taichi itself,
        compiled kernels and transfers to or from the host."""
        self._require_runtime()
        return held_bytes(self, self._engine, *self._engine.terms, self._particles, self._tape)

    def __reduce__(self) -> tuple[Any, ...]:
        """Raise TypeError: simulators cannot be copied or pickled."""
        raise TypeError("simulators cannot be copied or pickled: build another, and use state and set_state")

    # -- settings -----------------------------------------------------------------------------------

    def set_contact(self, model: str | Sequence[str], softness: float | Sequence[float] = 666.0) -> None:
        """Set the contact model, without recompilation.

        Args:
            model: ``soft`` (strength exp(-softness d) outside the surface) or ``hard``; one value, or one per
                environment.
            softness: Decay rate of the soft model [1 / domain unit]; one value, or one per environment.
        """
        for label, given in (("contact", model), ("softness", softness)):
            if np.size(given) not in (1, self.batch):
                raise ArgumentError(f"{label} has {np.size(given)} values for {self.batch} environments")
        models = np.broadcast_to(model, self.batch)
        decay = np.broadcast_to(np.asarray(softness, float), self.batch)
        for name, rate in zip(models, decay, strict=True):
            if name not in CONTACTS:
                raise ArgumentError(f"contact '{name}' is not one of {', '.join(CONTACTS)}")
            if name == "soft" and not rate > 0:
                raise ArgumentError(f"softness {rate:g} must be positive")
        self._version += 1
        self._engine.write(self._engine.alpha, np.where(models == "soft", decay, 0.0))

    def set_weights(self, weights: Mapping[str, float]) -> None:
        """Set the weights of loss terms in the trajectory loss and its gradient, without recompilation.

        Args:
            weights: Weights by name of the term.

        Raises:
            ValueError: If the simulator was built without a term.
        """
        columns = {term.name: column for column, term in enumerate(self._engine.terms) if term.weighted}
        held = self._engine.read(self._engine.term_weights)
        for name, weight in weights.items():
            if name not in columns:
                known = ", ".join(columns) or "none"
                raise ArgumentError(f"this simulator was built without a term '{name}'; it has: {known}")
            held[columns[name]] = weight
        self._engine.write(self._engine.term_weights, held)

    def set_scenes(self, scenes: Sequence[Scene], *, particles: Sequence[np.ndarray] | None = None) -> None:
        """Replace all scenes by scenes of the same kind and reset, without recompilation.

        Contact model, weights and targets are unchanged.

        Args:
            scenes: One scene per environment.
            particles: Initial positions per environment, each [particle, 3]; sampled from the scene if None.

        Raises:
            SceneError: If a scene cannot be simulated or is of another kind.
            ValueError: If positions are wrong. Nothing is changed in these cases.
        """
        self._require_runtime()
        self._require_fitting(scenes)
        positions = self._start_positions(scenes, particles)
        self.scenes = tuple(scenes)
        self.changes += 1
        self._engine.fill_parameters(scenes)
        self._start_from(positions)
        self.reset()

    @property
    def material_keys(self) -> tuple[str, ...]:
        """Names of the material's parameters, in the order of :meth:`material_gradient`."""
        return material_keys(self.scenes[0])

    def set_material(self, *values: ArrayLike | None, **named: ArrayLike | None) -> None:
        """Set material parameters, without recompilation.

        Args:
            *values: Parameter values in the order of :attr:`material_keys`; None leaves a parameter
                unchanged. Each is a scalar or has shape [batch], for all bodies whose law has the parameter;
                if bodies have their own materials, also shape [batch, body].
            **named: Parameter values by name.

        Raises:
            SceneError: If a scene cannot be simulated with these values, or values per body are given for a
                single material; nothing is changed in these cases.
            ValueError: If there are more values than parameters.
        """
        self._require_runtime()
        keys = self.material_keys
        if len(values) > len(keys):
            raise ArgumentError(f"{len(values)} values for {len(keys)} parameters, {', '.join(keys)}")
        given = {**dict(zip(keys, values, strict=False)), **named}
        scenes = with_material(self.scenes, {key: value for key, value in given.items() if value is not None})
        for scene in scenes:
            scene.validate()
        self.scenes = scenes
        self.changes += 1
        self._version += 1
        self._engine.fill_material(scenes)

    def set_target(self, mass: np.ndarray, sdf: np.ndarray) -> None:
        """Set the targets of all environments.

        Args:
            mass: Target mass tensors, shape [batch, n, n, n].
            sdf: Distance of each node to the target [domain units], same shape.

        Raises:
            ValueError: If a shape is wrong, or a number is NaN or infinite.
        """
        self._require_runtime()
        expected = (self.batch, self.grid_size, self.grid_size, self.grid_size)
        for name, value in (("mass", mass), ("sdf", sdf)):
            if np.shape(value) != expected:
                raise ArgumentError(f"target {name} has shape {np.shape(value)}, not {expected}")
            require_finite(f"target {name}", self._real(value), "node", axes=3)
        self.target_mass = mass
        self.change_targets(dict(enumerate(zip(mass, sdf, strict=True))))

    def change_targets(self, targets: Mapping[int, tuple[np.ndarray, np.ndarray]]) -> None:
        """Replace the targets of some environments; the others must have targets.

        Args:
            targets: Finite mass tensor and distance by environment, as in :meth:`set_target`.
        """
        self._require_runtime()
        self.changes += 1
        # A copy, because callers may modify and pass the same array again, and keep the former masses.
        self.target_mass = np.array(self.target_mass)
        for e, (mass, sdf) in targets.items():
            self.target_mass[e] = mass
            held = {"mass": self._real(mass), "sdf": self._real(sdf)}
            for name, field in self._engine.references.items():
                self._engine.write(field, held[name], e)
            exact = held["mass"].astype(np.float64)
            for term in self._engine.terms:
                term.set_target(e, exact, held["sdf"])

    def change_scenes(self, scenes: Sequence[Scene], particles: Mapping[int, np.ndarray]) -> None:
        """Replace all scenes by scenes of the same kind between episodes, without recompilation.

        Current states, targets, contact model and weights are unchanged. Environments keep their initial
        particles unless new ones are given, and manipulators their initial poses unless those of the scene
        differ.

        Args:
            scenes: One scene per environment.
            particles: Initial positions by environment, each of shape [particle, 3].

        Raises:
            SceneError: If a scene cannot be simulated or is of another kind; nothing is changed then.
            ValueError: If positions have a wrong shape.
        """
        self._require_runtime()
        self._require_fitting(scenes)
        held = {e: checked_positions(x, scenes[0], f"particles[{e}]") for e, x in particles.items()}
        before, poses, joints = initial_poses(self.scenes), self._initial_poses, self._initial_joints
        self.scenes = tuple(scenes)
        self.changes += 1
        self._version += 1
        self._engine.fill_parameters(scenes)
        self._start_manipulators()
        same = (self._initial_poses == before).all(axis=2)
        self._initial_poses[same] = poses[same]
        if joints is not None and self._map is not None:
            self._initial_joints = np.where(same.all(axis=1)[:, None], joints, self._map.start)
        for e, x in held.items():
            order = self._particles.initial[e].astype(np.int32)
            self._engine.place_at_rest(self._initial, e, order, x.reshape(-1))

    # -- forward ------------------------------------------------------------------------------------

    def reset(self, environments: Sequence[int] | None = None) -> None:
        """Reset all or some environments to their initial states."""
        self._require_runtime()
        self._version += 1
        if environments is not None:
            chosen = np.zeros(self.batch, np.int32)
            chosen[list(environments)] = 1
            if self._impulses is not None:
                kept = np.array(self.impulses()) * (chosen == 0)[:, None, None]
                copy_numbers(self._impulses, 0, kept.reshape(-1), kept.size, True)
            self._engine.copy_chosen(self._initial, self._particles.current, chosen)
            self._particles.reset_order(np.flatnonzero(chosen).tolist())
            rows = chosen[:, None] != 0
            if self._initial_joints is not None:
                held = self._joints.cpu() if on_device(self._joints) else self._joints
                self._joints = np.where(rows, self._initial_joints, held)
            self._place(np.where(rows[:, None], self._initial_poses, self.poses()))
            return
        self._engine.copy_slot(self._initial, 0, self._particles.current, 0)
        self._particles.reset_order()
        self._joints = self._initial_joints
        self._place(self._initial_poses)
        self._take_impulses(clear=True)
        self._checked = True

    def step(self, actions: np.ndarray | torch.Tensor, *, check: bool = True) -> None:
        """Advance all environments by one environment step, without storing history.

        Args:
            actions: Actions, shape [batch, action]; clipped to [-1, 1]. CUDA tensors stay on the device.
            check: Whether to wait for the step and check for divergence. If False, the next :meth:`measure`
                does.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If the simulation diverges and ``check`` is True.
        """
        self._require_runtime()
        self._version += 1
        through = partial(self._follow, gradient=False) if self._map else None
        array = kernel_actions(actions, self._engine, self.action_dim, through)
        # Tensors in another stream than PyTorch's default are in a Taichi array already.
        if isinstance(array, np.ndarray):
            from_host(self._actions, array)
            array = self._actions
        # Discard the impulses of earlier rollouts.
        self._take_impulses()
        self._particles.step(self._pose, array)
        self._take_impulses()
        self._taken += 1
        self._checked = check
        if check:
            faults = self._engine.read(self._engine.fault)
            require_none(broken_states(faults, self.substeps, self._taken))

    def measure(self, like: torch.Tensor | None = None) -> Measures:
        """Return loss terms and soft IoU of the current state; if ``like`` is a CUDA tensor, so are the
        results.

        Raises:
            SimulationError: If the last step, made with ``check=False``, diverged.
        """
        self._require_runtime()
        if on_device(like):
            size = self.batch * self._engine.measures
            values = output_for(lambda out: self._particles.losses(out, 0), size, True, like)
            values = values.reshape(self.batch, -1)
        else:
            self._particles.losses(self._scratch_terms, 0)
            values = numbers_of(self._scratch_terms, (self.batch, self._engine.measures), None)
        checked, self._checked = self._checked, True
        if not checked:
            require_none(broken_states(values[:, -1], self.substeps, self._taken))
        return self._judged(values)

    def losses(self) -> np.ndarray:
        """Return the unweighted loss terms of the current state, shape [batch, term]."""
        return self.measure().terms

    def mass_tensor(self) -> np.ndarray:
        """Return the mass at the grid nodes in the current state, shape [batch, n, n, n], float64."""
        self._require_runtime()
        self._particles.losses(self._scratch_terms, 0)
        return self._mass(None).astype(np.float64)

    def _mass(self, like: torch.Tensor | None) -> Any:
        """Return the mass tensors of the last losses, as an array or as a tensor like a CUDA tensor."""
        shape = self.batch, self.grid_size, self.grid_size, self.grid_size
        if on_device(like):
            double = self.precision == "float64"
            # The kernel writes only nodes with mass.
            mass = output_for(
                lambda out: self._engine.export_mass(out.zero_()), math.prod(shape), double, like
            )
            return mass.reshape(shape)
        out = np.zeros(math.prod(shape), self.precision)
        self._engine.export_mass(out)
        return out.reshape(shape)

    # -- state --------------------------------------------------------------------------------------

    def state(self) -> State:
        """Return the current state, with particles in their original order."""
        poses = cast(np.ndarray, self.poses())
        state = self._particles.unpack(to_host(self._particles.current), poses)
        joints = self._joints.cpu().numpy() if on_device(self._joints) else self._joints
        return state if joints is None else replace(state, joints=np.array(joints, np.float64))

    def observe(self, stride: int, like: torch.Tensor | None = None) -> np.ndarray | torch.Tensor:
        """Return position and velocity of every ``stride``-th particle, in the original order.

        Only these particles are copied from the device.

        Args:
            stride: Stride between the numbers of observed particles, at least 1.
            like: If a CUDA tensor, the result is a CUDA tensor of the same type, without a copy to the host.

        Returns:
            Position (3) and velocity (3), shape [batch, observed, 6], float32 or float64 like the simulation.
        """
        self._require_runtime()
        if not is_whole(stride):
            raise ArgumentError(f"stride must be a whole number of at least 1, not {stride}")
        return self._observe(self._particles.current, 0, stride, like)

    def _observe(
        self, state: ti.Ndarray, slot: int, stride: int, like: torch.Tensor | None
    ) -> np.ndarray | torch.Tensor:
        """Observe a time slot of an array with particles in the current order; see :meth:`observe`."""
        count = -(-self.particle_count // stride)
        size = self.batch * count * 6

        def fill(out: ti.Ndarray | torch.Tensor) -> None:
            self._engine.observe(state, slot, self._particles.numbers, stride, out)

        if on_device(like):
            return output_for(fill, size, self.precision == "float64", like).reshape(self.batch, count, 6)
        if stride not in self._observed:
            self._observed[stride] = ti.ndarray(self._runtime.real, shape=size)
        fill(self._observed[stride])
        return to_host(self._observed[stride]).reshape(self.batch, count, 6)

    def poses(self, like: torch.Tensor | None = None) -> np.ndarray | torch.Tensor:
        """Return the poses of the manipulators, float64, shape [batch, manipulator, 8]; see :class:`State`.
        If ``like`` is a CUDA tensor, so is the result."""
        self._require_runtime()
        return numbers_of(self._pose, self._initial_poses.shape, like)

    def impulses(self, like: torch.Tensor | None = None) -> np.ndarray | torch.Tensor:
        """Return the momentum transferred from the bodies to each manipulator in the last :meth:`step`, 0
        after a reset.

        Args:
            like: If a CUDA tensor, the result is a CUDA tensor of the same type.

        Returns:
            Impulses [mass x domain units / s], shape [batch, manipulator, 3]; divided by the duration of an
            environment step they are mean forces.

        Raises:
            RuntimeError: If the simulator was built without ``impulses=True``.
        """
        self._require_runtime()
        if self._impulses is None:
            raise RuntimeError("build the simulator with impulses=True")
        return numbers_of(self._impulses, (self.batch, self.manipulator_count, 3), like)

    def _take_impulses(self, clear: bool = False) -> None:
        if self._impulses is not None:
            self._engine.take_impulses(self._impulses)
            if clear:
                self._impulses.fill(0.0)

    def set_state(self, state: State) -> None:
        """Replace the current state.

        Args:
            state: Shapes as in :class:`State`.

        Raises:
            ValueError: If a shape is wrong, a position is outside the grid, or a number is NaN or infinite;
                nothing is changed then.
        """
        self._require_runtime()
        tails = {"x": (3,), "v": (3,), "C": (3, 3), "F": (3, 3)}
        expected = {name: (self.batch, self.particle_count, *tail) for name, tail in tails.items()}
        expected |= {"poses": self._initial_poses.shape, "joints": getattr(self._initial_joints, "shape", ())}
        for name, shape in expected.items():
            value = getattr(state, name)
            if np.shape(value) != shape:
                raise ArgumentError(f"{name} has shape {np.shape(value)}, not {shape}")
        checked_positions(state.x, self.scenes[0])
        entries = dict.fromkeys(("v", "C", "F"), "particle") | {"poses": "manipulator", "joints": "joint"}
        for name, entry in entries.items():
            if getattr(state, name) is not None:
                require_finite(name, self._real(getattr(state, name)), entry)
        self._version += 1
        from_host(self._particles.current, self._particles.pack(state))
        self._particles.reset_order()
        self._joints = None if state.joints is None else np.array(state.joints, np.float64)
        self._take_impulses(clear=True)
        self._place(state.poses)

    def initial_state(self) -> State:
        """Return the initial state of :meth:`reset` and :meth:`rollout`."""
        self._require_runtime()
        order = self._particles.initial
        state = self._particles.unpack(to_host(self._initial), self._initial_poses.copy(), order)
        return replace(state, joints=None if self._initial_joints is None else self._initial_joints.copy())

    def set_initial_state(self, state: State) -> None:
        """Replace the initial state of :meth:`reset` and :meth:`rollout`; shapes as in :class:`State`."""
        self.set_state(state)
        self.changes += 1
        self._initial_poses, self._initial_joints = np.array(state.poses, np.float64), self._joints
        self._engine.copy_slot(self._particles.current, 0, self._initial, 0)

    # -- rollouts and gradients -----------------------------------------------------------------------

    def rollout(
        self, actions: np.ndarray | torch.Tensor, gradient: bool = True, *, strict: bool = True
    ) -> Rollout:
        """Simulate environment steps from the initial state, and differentiate the trajectory loss.

        Args:
            actions: Actions, shape [batch, T, action]; clipped to [-1, 1]. For a CUDA tensor, results are
                tensors of the same type on the same device.
            gradient: Whether to compute the gradient.
            strict: Whether divergence of an environment raises an error instead of adding an entry to
                ``failures``.

        Returns:
            Loss terms per step and the gradient; the simulator is left in the final state.

        Raises:
            ValueError: If the shape is wrong, an action is not finite, or there is no loss to differentiate.
            SimulationError: If state, loss or gradient diverge and ``strict`` is True.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        if gradient and not self.terms:
            raise ArgumentError("there is no loss to differentiate: pass terms with weights to Simulator")
        array, steps, poses, plan = self._started(actions, gradient)
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * self.batch * self._engine.measures)
        self._particles.losses(terms, 0)
        self._tape.forward(array, poses, None if gradient else terms, steps, plan)
        actions_bar, failures = None, dict[int, str]()
        if gradient:
            bars = self._tape.backward(terms, self.steps_before_contact(steps))
            self._differentiated = self._version
            actions_bar = self._by_actions(bars, steps, actions, self._drive)
            failures = broken_gradients(actions_bar)
        self._end_at(poses, steps)
        values = numbers_of(terms, (steps + 1, self.batch, self._engine.measures), actions)
        failures |= broken_terms(values) | broken_states(values[-1, :, -1], self.substeps)
        if strict:
            require_none(failures)
        judged = self._judged(values)
        step_terms, step_iou = judged.terms[1:].swapaxes(0, 1), judged.iou[1:].T
        return Rollout(judged.terms[0], step_terms, judged.iou[0], step_iou, actions_bar, failures)

    def record(
        self,
        actions: np.ndarray | torch.Tensor,
        *,
        every_step: bool = True,
        mass: bool = True,
        gradient: bool = True,
    ) -> RecordedStates:
        """Simulate environment steps from the initial state, and return the states with a pullback for losses
        that the caller computes from them.

        Args:
            actions: Actions, shape [batch, T, action]; clipped to [-1, 1]. For a CUDA tensor, the states are
                tensors of the same type.
            every_step: Whether to return the state after every environment step, or only the last one.
            mass: Whether to return mass tensors.
            gradient: Whether :meth:`RecordedStates.pullback` will be called.

        Returns:
            The states; the simulator is left in the last one.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If the state stops being finite.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        return RecordedStates(self, actions, every_step, mass, gradient)

    def closed_loop(
        self,
        steps: int,
        choose: Callable[[int, Any, Any], Any],
        react: Callable[[int, Any], tuple[Any, Any] | None],
        *,
        stride: int = 1,
        discount: float = 1.0,
        like: torch.Tensor | None = None,
    ) -> np.ndarray | torch.Tensor:
        """Simulate environment steps with actions chosen from observations, and backpropagate through states
        and policy.

        Args:
            steps: Environment steps T.
            choose: Policy, called with t = 0 to T, positions and velocities as from :meth:`observe`, and
                poses as from :meth:`poses`. Returns the actions of step t, shape [batch, action], clipped to
                [-1, 1]; the result for T is ignored.
            react: Pullback of the policy, called with t = T to 0 and the derivative of the loss with respect
                to the actions of step t, shape [batch, action], None for T. Returns the derivatives with
                respect to the observations before step t through these actions (for T: of a function of the
                last observation that is added to the loss), in their shapes, or None; the result for 0 is
                ignored.
            stride: Stride between the numbers of observed particles.
            discount: Discount factor; the loss of step t is weighted by ``discount ** t``.
            like: If a CUDA tensor, all arrays are CUDA tensors of the same type.

        Returns:
            Unweighted loss terms after each step, shape [batch, T, term]; the simulator is left in the last
            state.

        Raises:
            ValueError: If a shape is wrong, an action is not finite, or there is no loss to differentiate.
            SimulationError: If state, loss or gradient stop being finite.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        if not self.terms:
            raise ArgumentError("there is no loss to differentiate: pass terms with weights to Simulator")
        if steps < 1:
            raise ArgumentError(f"steps must be at least 1, not {steps}")
        poses = self._pose_history(steps, np.asarray(self.poses()))
        engine, particles, tape = self._engine, self._particles, self._tape
        row, posed_shape = engine.batch * engine.actions_per_step, (engine.batch, engine.manipulators, 8)
        seen_shape = engine.batch, -(-engine.particles // stride), 6
        actions = ti.ndarray(ti.f64, shape=max(1, steps * row))
        actions_bar = ti.ndarray(ti.f64, shape=actions.shape)
        # Particle order at each observation, and motions of articulated models in each step.
        numbers: list[ti.Ndarray] = []
        drives: list[LinkMotion | None] = []
        joints_bar: Any = None

        def observe(last: int, state: ti.Ndarray, slot: int) -> None:
            """Observe the state after step ``last``, and choose the actions of the next one."""
            t = last + 1
            # Before the policy returns NaN for the observations of a diverged environment.
            require_none(broken_states(engine.read(engine.fault), engine.substeps, self._taken + 1))
            numbers.append(particles.noted_order())
            posed = numbers_of(poses, posed_shape, like, first=t * int(np.prod(posed_shape)))
            chosen = choose(t, self._observe(state, slot, stride, like), posed)
            if t < steps:
                through = self._follow if self._map else None
                given = kernel_actions(chosen, engine, self.action_dim, through)
                drives.append(self._drive)
                copy_numbers(actions, t * row, given, row, True)

        def react_at(t: int) -> tuple[Any, Any] | None:
            """Return the derivatives with respect to the observation before step t, or the last observation,
            given the adjoint of its actions."""
            nonlocal joints_bar
            if t == steps:
                return react(t, None)
            bar = numbers_of(actions_bar, (engine.batch, engine.actions_per_step), like, first=t * row)
            if drive := drives[t]:
                # From the last to the first step, because later steps depend on the joints of earlier ones.
                by_actions, joints_bar = drive.pull_back(bar[None], joints_bar)
                bar = by_actions[0].to(bar.dtype) if on_device(bar) else by_actions[0]
            return react(t, bar)

        def add(t: int, _state: ti.Ndarray, _slot: int, bar: ti.Ndarray) -> None:
            """Add the contribution of the observation after step t to the adjoint of its state."""
            if discount != 1.0:
                engine.write(engine.term_weights, weights * discount**t)
            given = react_at(t + 1)
            if given is None:
                return
            seen, posed = given
            if (tuple(seen.shape), tuple(posed.shape)) != (seen_shape, posed_shape):
                raise ArgumentError(
                    f"derivatives with respect to the observation have shapes {tuple(seen.shape)} and "
                    f"{tuple(posed.shape)}, not {seen_shape} and {posed_shape}"
                )
            for first in (0, AT_V):
                shape = engine.batch, engine.particles, 3
                whole = seen.new_zeros(shape) if on_device(seen) else np.zeros(shape, seen.dtype)
                whole[:, ::stride] = seen[..., first : first + 3]
                engine.add_cotangents(bar, numbers[t + 1], whole.reshape(-1), first)
            if engine.manipulators:
                engine.add_pose_cotangents(flat(posed))

        self._version += 1
        # Contact before these steps does not depend on their actions.
        engine.write(engine.touched, np.zeros(engine.batch))
        plan = tape.plan(steps, self.memory_mb)
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * engine.batch * engine.measures)
        observe(-1, particles.current, 0)
        tape.forward(actions, poses, None, steps, plan, after=observe)
        with self._kept_weights() as weights:
            tape.backward(terms, self.steps_before_contact(steps), add, actions_bar)
        bars = numbers_of(actions_bar, (steps, engine.batch, engine.actions_per_step), like)
        require_none(broken_gradients(bars.swapaxes(0, 1)))
        react_at(0)
        self._end_at(poses, steps)
        values = numbers_of(terms, (steps + 1, engine.batch, engine.measures), like)
        return self._judged(values).terms[1:].swapaxes(0, 1)

    def state_gradient(self) -> State:
        """Return the gradient of the last :meth:`rollout`'s loss with respect to its initial state.

        The backward pass computes it; this method copies it from the device. Gradients with respect to
        quaternions are those of the rotation matrix as a polynomial; project them onto the tangent space.
        Poses of static manipulators, and rotations of shapes that cannot turn, have the gradient 0.

        Raises:
            RuntimeError: If the simulator was built without ``full_gradient=True``, or has been used or
                changed since a rollout with a gradient.
        """
        self._require_gradient()
        assert self._tape.bar is not None
        return self._adjoint(self._tape.bar, self._particles.initial)

    def material_gradient(self) -> np.ndarray:
        """Return the gradient of the last :meth:`rollout`'s loss with respect to the material.

        Returns:
            Derivatives with respect to the parameters in :attr:`material_keys` (Young's modulus, Poisson
            ratio and yield stress for von Mises plasticity), shape [batch, parameter]; if bodies have their
            own materials, shape [batch, body, parameter], 0 for parameters that a body's law does not have.

        Raises:
            RuntimeError: As for :meth:`state_gradient`.
        """
        self._require_gradient()
        materials, keys = self._engine.materials, self.material_keys
        bars = self._engine.material_bar.to_numpy()
        bars = bars.reshape(self.batch, -1, materials, bars.shape[1]).sum(axis=1)
        gradient = np.zeros((self.batch, materials, len(keys)))
        for e, scene in enumerate(self.scenes):
            for b, material in enumerate(scene.materials[:materials]):
                law = material.kind
                slopes = law.parameter_gradient(material.values, bars[e, b, : law.size])
                gradient[e, b, [keys.index(key) for key in law.keys]] = slopes
        return gradient if materials > 1 else gradient[:, 0]

    def world_gradient(self) -> dict[str, np.ndarray]:
        """Return the gradient of the last :meth:`rollout`'s loss with respect to gravity and friction.

        Returns:
            Derivatives with respect to ``floor_friction``, shape [batch], ``gravity``, shape [batch, 3], and
            the manipulators' ``friction``, shape [batch, manipulator]. At the onset of sticking one-sided
            derivatives differ; while a node sticks they are 0.

        Raises:
            RuntimeError: As for :meth:`state_gradient`.
        """
        self._require_gradient()
        bar = self._engine.world_bar.to_numpy()
        bar = bar.reshape(self.batch, -1, WORLD + self.manipulator_count).sum(1)
        return {"floor_friction": bar[:, 0], "gravity": bar[:, 1:WORLD], "friction": bar[:, WORLD:]}

    def loss_gradient(self) -> State:
        """Return the gradient of the weighted loss of the current state with respect to that state, without
        simulation.

        Gradients with respect to quaternions are as in :meth:`state_gradient`, whose result remains valid.
        """
        self._require_runtime()
        self._engine.allocate_adjoint()
        bar, kept = self._particles.array(1), self._engine.pose_bar.to_numpy()
        self._engine.pose_bar.fill(0)
        self._particles.losses(self._scratch_terms, 0)
        self._engine.loss_gradient_kernel(self._particles.current, 0, bar)
        gradient = self._adjoint(bar)
        self._engine.pose_bar.from_numpy(kept)
        return gradient

    def steps_before_contact(self, steps: int) -> int:
        """Return how many of the last rollout's ``steps`` precede the first contact in any environment; 0 if
        the full gradient is requested."""
        if self._engine.full_gradient:
            return 0
        engine = self._engine
        touched, untouched = engine.read(engine.touched), engine.read(engine.untouched_step)
        return int(np.where(touched != 0, untouched, steps).min())

    # -- internals ------------------------------------------------------------------------------------

    def _started(
        self, actions: np.ndarray | torch.Tensor, gradient: bool
    ) -> tuple[ti.Ndarray, int, ti.Ndarray, int | None]:
        """Reset; return actions, number of steps, pose history, and steps per segment of a gradient."""
        self.reset()
        through = partial(self._follow, gradient=gradient) if self._map else None
        array = kernel_actions(actions, self._engine, self.action_dim, through, rollout=True)
        steps = np.shape(actions)[1]
        plan = self._tape.plan(steps, self.memory_mb) if gradient else None
        return array, steps, self._pose_history(steps, self._initial_poses), plan

    def _follow(self, actions: Any, gradient: bool = True) -> Any:
        """Apply actions, shape [T, batch, A], to the joints of the articulated models; return the actions of
        the manipulators."""
        assert self._map is not None
        self._drive = self._map.drive(self._joints, actions, gradient)
        self._joints = self._drive.joints
        return self._drive.twists

    def _by_actions(
        self, bars: ti.Ndarray, steps: int, like: Any, drive: LinkMotion | None
    ) -> np.ndarray | torch.Tensor:
        """Convert derivatives with respect to manipulator motions to derivatives with respect to actions,
        shape [batch, T, A]."""
        shape = steps, self.batch, self._engine.actions_per_step
        bar = numbers_of(bars, shape, drive.twists if drive else like)
        if drive:
            bar = drive.pull_back(bar)[0]
        return (bar.to(like.dtype) if on_device(bar) else bar).swapaxes(0, 1)

    def _judged(self, values: np.ndarray | torch.Tensor) -> Measures:
        """Convert measures, shape [..., batch, measure], to loss terms and soft IoU; see
        :class:`plab.sim.term_phases.TermPhases`."""
        terms = self._engine.terms
        peak = values[..., len(terms)]
        judges = [term.iou(values[..., k], peak) for k, term in enumerate(terms) if not term.weighted]
        iou = judges[0] if judges else peak * np.nan
        # Terms without weight, which are only measured, come last.
        return Measures(values[..., : len(self.terms)], iou)

    def _adjoint(self, bar: ti.Ndarray, order: np.ndarray | None = None) -> State:
        poses = self._engine.pose_bar.to_numpy().reshape(self.batch, -1, 8)[:, : self.manipulator_count]
        return self._particles.unpack(to_host(bar), poses, order)

    def _require_fitting(self, scenes: Sequence[Scene]) -> None:
        require_alike(scenes, self.scenes[0])
        if len(scenes) != self.batch:
            raise SceneError(f"{len(scenes)} scenes for a simulator of {self.batch} environments")

    def _start_positions(
        self, scenes: Sequence[Scene], particles: Sequence[np.ndarray] | None
    ) -> list[np.ndarray]:
        """Return checked initial positions, by default sampled from the scenes."""
        if particles is not None and len(particles) != self.batch:
            raise ArgumentError(f"particles of {len(particles)} environments, not of {self.batch}")
        given = once_each(sample_particles, scenes) if particles is None else particles
        names = [f"particles[{e}]" if self.batch > 1 else "particles" for e in range(self.batch)]
        return [checked_positions(x, scenes[0], name) for x, name in zip(given, names, strict=True)]

    def _start_from(self, positions: Sequence[np.ndarray]) -> None:
        self._particles.start_order(positions)
        self._engine.fill_bodies(self.scenes, self._particles.initial)
        self._start_manipulators()
        from_host(self._initial, self._particles.at_rest(np.stack(positions)))

    def _start_manipulators(self) -> None:
        self._initial_poses = initial_poses(self.scenes)
        self._map: JointActions | None = None
        if self.scenes[0].kinematics:
            # Imported here, because other scenes do not need PyTorch.
            from plab.kinematics.actions import JointActions

            self._map = JointActions(self.scenes, self.device)
        self._initial_joints = self._map.start if self._map else None

    def _real(self, values: ArrayLike) -> np.ndarray:
        """Convert to the simulation's precision; numbers beyond its range become infinite."""
        with np.errstate(over="ignore"):
            return np.asarray(values, self.precision)

    def _end_at(self, poses: ti.Ndarray, steps: int) -> None:
        """Place the manipulators at the end of ``steps`` simulated steps, given the pose history."""
        self._engine.place(poses, steps, self._pose, 0)
        self._taken += steps

    def _place(self, poses: np.ndarray) -> None:
        """Place the manipulators at the start of an episode and clear failures."""
        if self.manipulator_count:
            from_host(self._pose, np.ascontiguousarray(poses, np.float64))
        self._engine.place(self._pose, 0, self._pose, 1)
        self._taken = 0

    def _require_runtime(self) -> None:
        require_current(self._runtime)

    @contextmanager
    def _kept_weights(self) -> Iterator[np.ndarray]:
        """Restore the weights of the terms after the ``with`` block."""
        weights = self._engine.read(self._engine.term_weights)
        try:
            yield weights
        finally:
            self._engine.write(self._engine.term_weights, weights)

    def _pose_history(self, steps: int, first: np.ndarray) -> ti.Ndarray:
        """Allocate the pose history of T environment steps; the initial poses are set."""
        poses = ti.ndarray(ti.f64, shape=max(1, (steps + 1) * self.batch * self.manipulator_count * 8))
        if first.size:
            from_host(poses, np.ascontiguousarray(first, np.float64))
        return poses

    def _require_gradient(self) -> None:
        self._require_runtime()
        if not self._engine.full_gradient:
            raise RuntimeError("build the simulator with full_gradient=True for this gradient")
        if self._differentiated != self._version:
            raise RuntimeError(
                "there is no gradient of the last simulation: call rollout(actions, gradient=True), and read "
                "its gradients before the next simulation or change"
            )
