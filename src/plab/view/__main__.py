"""``python -m plab.view``: a page that plays a rollout; see :mod:`plab.cli.view`."""

import sys

from plab.cli.view import main

if __name__ == "__main__":
    sys.exit(main())
