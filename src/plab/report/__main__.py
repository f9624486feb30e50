"""``python -m plab.report``: tables, curves, notebooks and a page; see :mod:`plab.cli.report`."""

import sys

from plab.cli.report import main

if __name__ == "__main__":
    sys.exit(main())
