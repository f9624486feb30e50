"""``python -m plab.results``: result files; see :mod:`plab.cli.results`."""

import sys

from plab.cli.results import main

if __name__ == "__main__":
    sys.exit(main())
