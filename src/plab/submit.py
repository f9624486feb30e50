"""``python -m plab.submit``: pack what a method produced for the leaderboard; see :mod:`plab.cli.submit`."""

import sys

from plab.cli.submit import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
