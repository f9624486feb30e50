"""``python -m plab.render``: alias of ``plab render``."""

from plab.cli.rollouts import render

if __name__ == "__main__":
    raise SystemExit(render())
