"""``python -m plab.view``: the same as ``plab view``."""

from plab.cli.rollouts import view

if __name__ == "__main__":
    raise SystemExit(view())
