"""The Taichi simulator: usable alone, with no Hydra, Gymnasium or torch around it."""

from plab.sim.runtime import DEVICES, PRECISIONS, DeviceError, SimulationError
from plab.sim.simulator import CONTACT_MODELS, Rollout, Simulator, State

__all__ = [
    "CONTACT_MODELS",
    "DEVICES",
    "PRECISIONS",
    "DeviceError",
    "Rollout",
    "SimulationError",
    "Simulator",
    "State",
]
