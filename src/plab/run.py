"""``python -m plab.run``: one run, or a sweep; see :mod:`plab.cli.run`."""

import sys

from plab.cli.run import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
