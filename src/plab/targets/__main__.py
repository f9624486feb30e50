"""``python -m plab.targets``: the same as ``plab targets``."""

from plab.cli.suite import targets

if __name__ == "__main__":
    raise SystemExit(targets())
