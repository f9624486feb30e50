"""``python -m plab.report``: the same as ``plab report``."""

from plab.cli.report import main

if __name__ == "__main__":
    raise SystemExit(main())
