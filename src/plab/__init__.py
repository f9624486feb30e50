"""plab: PlasticineLab rebuilt as an experiment harness, from one command line to the result file."""

__version__ = "0.1.0"
