"""The Taichi simulator: usable alone, with no Hydra, Gymnasium or torch around it."""

from plab.sim.runtime import DEVICES, PRECISIONS, DeviceError, SimulationError
from plab.sim.simulator import CONTACT_MODELS, Measures, Rollout, Simulator, State

__all__ = [
    "CONTACT_MODELS",
    "DEVICES",
    "PRECISIONS",
    "DeviceError",
    "Measures",
    "Rollout",
    "SimulationError",
    "Simulator",
    "State",
]
