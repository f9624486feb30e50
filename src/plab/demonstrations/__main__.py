"""``python -m plab.demonstrations``: see :mod:`plab.cli.demonstrations`."""

import sys

from plab.cli.demonstrations import main

if __name__ == "__main__":
    sys.exit(main())
