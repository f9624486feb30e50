"""``python -m plab.run``: alias of ``plab run``."""

import sys

from plab.cli.run import main

if __name__ == "__main__":
    sys.exit(main())
