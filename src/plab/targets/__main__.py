"""``python -m plab.targets``: build and describe the suite's targets; see :mod:`plab.cli.targets`."""

import sys

from plab.cli.targets import main

if __name__ == "__main__":
    sys.exit(main())
