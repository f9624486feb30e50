"""``python -m plab.results``: alias of ``plab results``."""

from plab.cli.results import main

if __name__ == "__main__":
    raise SystemExit(main())
