"""``python -m plab.export``: rollouts for ParaView and Blender; see :mod:`plab.cli.export`."""

import sys

from plab.cli.export import main

if __name__ == "__main__":
    sys.exit(main())
