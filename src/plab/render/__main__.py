"""``python -m plab.render``: pictures and films; see :mod:`plab.cli.render`."""

import sys

from plab.cli.render import main

if __name__ == "__main__":
    sys.exit(main())
