"""``python -m plab.demonstrations``: alias of ``plab demonstrations``."""

from plab.cli.suite import demonstrations

if __name__ == "__main__":
    raise SystemExit(demonstrations())
