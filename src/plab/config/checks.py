"""What can be found wrong with a run before anything is compiled, beyond the configuration itself."""

from __future__ import annotations

import ctypes
import sys
from importlib.util import find_spec

from plab.config.compose import build_scene
from plab.config.run import Config
from plab.errors import ConfigError
from plab.targets import check_target, load_release_target

__all__ = ["check_device", "check_packages", "check_sources", "cuda_devices", "cuda_is_usable"]


def check_sources(cfg: Config) -> None:
    """Find mistakes in the scene and in what the target comes from: ConfigError, SceneError or
    TargetError. So is a scene for which there is too little memory."""
    # Imported here: Taichi takes a second.
    from plab.sim.memory import require_memory

    scene, source = build_scene(cfg), cfg.targets.source
    require_memory([scene], cfg.sim.precision, cfg.sim.device)
    if source is None:
        check_target(scene, cfg.task.target)
    else:
        load_release_target(source, scene, cfg.variant)


def check_device(cfg: Config) -> None:
    """Raise ConfigError unless this computer has the device."""
    if cfg.sim.device == "cuda" and not cuda_is_usable():
        raise ConfigError("sim.device=cuda: this computer has no usable CUDA device; choose sim.device=cpu")


def check_packages(cfg: Config) -> None:
    """Raise ConfigError unless the optional packages that a run uses are installed."""
    if cfg.logger != "none" and find_spec(cfg.logger) is None:
        name = {"tensorboard": "TensorBoard", "wandb": "Weights & Biases"}[cfg.logger]
        raise ConfigError(f"logger={cfg.logger} needs {name}: pip install 'plab[{cfg.logger}]'")


def cuda_is_usable() -> bool:
    """Return whether there is a CUDA device."""
    return cuda_devices() > 0


def cuda_devices() -> int:
    """Return how many CUDA devices there are, by asking the driver: there is no library to import."""
    count = ctypes.c_int(0)
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return 0
    answered = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    return count.value if answered else 0
