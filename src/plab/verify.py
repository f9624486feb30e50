"""``python -m plab.verify``: simulate submissions again; see :mod:`plab.cli.verify`."""

import sys

from plab.cli.verify import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
