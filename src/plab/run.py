"""``python -m plab.run``: one run, or a sweep; see :mod:`plab.cli.run`."""

import gc
import sys

from plab.cli.run import main

__all__ = ["main"]

if __name__ == "__main__":
    # Libraries and traced kernels are many objects and no garbage: Python's 700 has them searched 800 times.
    gc.set_threshold(100_000)
    sys.exit(main())
