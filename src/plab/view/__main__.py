"""``python -m plab.view``: alias of ``plab view``."""

from plab.cli.rollouts import view

if __name__ == "__main__":
    raise SystemExit(view())
