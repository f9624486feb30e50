"""plab: PlasticineLab rebuilt as an experiment harness, from one command line to the result file."""

from plab.envs import register_suite

__version__ = "0.1.0"

register_suite()
