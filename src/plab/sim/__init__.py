"""The Taichi simulator: usable alone, with no Hydra, Gymnasium or torch around it."""

from plab.sim.recording import Recording
from plab.sim.runtime import DeviceError, SimulationError
from plab.sim.simulator import Simulator
from plab.sim.state import Measures, Rollout, State

__all__ = [
    "DeviceError",
    "Measures",
    "Recording",
    "Rollout",
    "SimulationError",
    "Simulator",
    "State",
]
