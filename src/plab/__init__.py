"""plab: PlasticineLab rebuilt as an experiment harness, from one command line to the result file."""

import os

# Before Taichi is imported, by whichever part of plab: it would print a banner on standard output, and send
# version, platform and a number of its own to its makers.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

from plab.envs import register_suite

__version__ = "0.1.0"

register_suite()
