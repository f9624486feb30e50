"""``python -m plab.export``: the same as ``plab export``."""

from plab.cli.rollouts import export

if __name__ == "__main__":
    raise SystemExit(export())
