"""``python -m plab``: alias of ``plab``; see :mod:`plab.cli.main`."""

import sys

from plab.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
