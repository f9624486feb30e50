"""A page on which a run's best actions, or the best actions known for a task, are played in 3-D.

plab view RESULT_FILE [--output FILE.html]
plab view KEY=VALUE ... [--output FILE.html]

It plays in any browser: particles, manipulators, and the target as a ghost.

EXAMPLES
  plab view results/Rope-v1/adam/seed0-12ab34cd.h5
  plab view task=Torus variant=2 --output torus.html
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from plab.cli.arguments import folder, require_writable
from plab.cli.command import command_line
from plab.cli.rollouts import make_parser, rollout, settle
from plab.render.graphics import RenderError, require_packages

__all__ = ["main"]


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    arguments = _parse(argv)
    require_packages("the viewer needs", {"k3d": "K3D-jupyter", "pyvista": "PyVista"}, "view")
    # Imported here: it loads the simulator, for which no mistake above should have to wait.
    from plab.render.recording import record_with_motion
    from plab.view.page import page

    text = page(record_with_motion(*rollout(arguments)), arguments.every)
    try:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RenderError(f"cannot write {arguments.output}: {error.strerror or error}") from error
    print(arguments.output)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """Return the arguments, checked as far as can be done without simulating."""
    parser = make_parser("view", __doc__, "the page")
    parser.add_argument(
        "--output", type=folder, metavar="FILE", help="by default a .html named like the result or the task"
    )
    arguments = parser.parse_intermixed_args(argv)
    settle(arguments, ".html")
    if arguments.output.suffix.lower() != ".html":
        raise RenderError(f"cannot write {arguments.output}: its suffix must be .html")
    require_writable(arguments.output)
    return arguments
