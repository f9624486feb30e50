"""``python -m plab.status``: alias of ``plab status``."""

from plab.cli.status import main

if __name__ == "__main__":
    raise SystemExit(main())
