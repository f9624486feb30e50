"""``python -m plab.export``: alias of ``plab export``."""

from plab.cli.rollouts import export

if __name__ == "__main__":
    raise SystemExit(export())
