"""What a benchmark's command line answers to mistakes: one line."""

from __future__ import annotations

import sys
from collections.abc import Callable

from plab.config import ConfigError
from plab.config_errors import COMPOSE_ERRORS, explain
from plab.scene import SceneError
from plab.sim import DeviceError, SimulationError
from plab.targets import TargetError

__all__ = ["answered"]

EXIT_USER_ERROR = 2


def answered(run: Callable[[], int]) -> int:
    """Run a benchmark; say in one line what is wrong with what it was asked for.

    Args:
        run: The benchmark; returns its exit code.

    Returns:
        This, or 2 for a mistake of the user's.
    """
    try:
        return run()
    except COMPOSE_ERRORS as error:
        message = explain(error)
    except (ConfigError, SceneError, TargetError, DeviceError, SimulationError, MemoryError) as error:
        message = str(error)
    except OSError as error:
        message = f"cannot write {error.filename}: {error.strerror}"
    print(f"plab: {message}", file=sys.stderr)
    return EXIT_USER_ERROR
