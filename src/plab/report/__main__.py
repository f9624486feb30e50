"""``python -m plab.report``: alias of ``plab report``."""

from plab.cli.report import main

if __name__ == "__main__":
    raise SystemExit(main())
