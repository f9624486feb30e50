"""``python -m plab.render``: the same as ``plab render``."""

from plab.cli.rollouts import render

if __name__ == "__main__":
    raise SystemExit(render())
