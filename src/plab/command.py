"""What command lines that simulate answer to mistakes: one line."""

from __future__ import annotations

import sys
from collections.abc import Callable

from plab.arguments import told
from plab.config import ConfigError
from plab.results import ResultsError
from plab.scene import SceneError
from plab.sim import DeviceError, SimulationError
from plab.targets import TargetError

__all__ = ["answered"]

EXIT_USER_ERROR = 2

_TOLD = (ConfigError, SceneError, TargetError, DeviceError, SimulationError, ResultsError, MemoryError)


def answered(run: Callable[[], int]) -> int:
    """Run what a command line asks for; say in one line what is wrong with it.

    Args:
        run: What is asked for; returns its exit code.

    Returns:
        This, or 2 for a mistake of the user's.
    """
    try:
        return run()
    except _TOLD as error:
        message = str(error)
    except OSError as error:
        message = told(error)
    print(f"plab: {message}", file=sys.stderr)
    return EXIT_USER_ERROR
