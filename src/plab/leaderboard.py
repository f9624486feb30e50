"""``python -m plab.leaderboard``: a page from a folder of submissions; see :mod:`plab.cli.leaderboard`."""

import sys

from plab.cli.leaderboard import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
