"""``python -m plab.status``: what is done, running, failed and missing; see :mod:`plab.cli.status`."""

import sys

from plab.cli.status import main

if __name__ == "__main__":
    sys.exit(main())
