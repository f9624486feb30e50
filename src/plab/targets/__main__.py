"""``python -m plab.targets``: alias of ``plab targets``."""

from plab.cli.suite import targets

if __name__ == "__main__":
    raise SystemExit(targets())
