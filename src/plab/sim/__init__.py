"""Simulator in Taichi, usable without Hydra, Gymnasium and torch."""

# First: it changes the decorators of the kernels that the others define.
import plab.sim.compiler  # noqa: F401
from plab.sim.runtime import DeviceError, SimulationError
from plab.sim.simulator import Simulator
from plab.sim.state import Measures, Rollout, State
from plab.sim.tape import RecordedStates

__all__ = ["DeviceError", "Measures", "RecordedStates", "Rollout", "SimulationError", "Simulator", "State"]
