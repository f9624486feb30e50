"""The viewer's command line: ``python -m plab.view RESULT_FILE`` writes a page that plays a rollout."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from plab.cli.arguments import folder
from plab.cli.command import command_line
from plab.cli.rollouts import make_parser, require_writable, rollout, settle
from plab.render.graphics import RenderError, require_packages

__all__ = ["main"]

_USAGE = """\
python -m plab.view RESULT_FILE [--output FILE.html]
python -m plab.view KEY=VALUE ... [--output FILE.html]

Writes a page on which the best actions of a run, or the best actions known for a task, are played in 3-D, in
any browser: particles, manipulators, and the target as a ghost.

EXAMPLES
  python -m plab.view results/Rope-v1/adam/seed0-12ab34cd.h5
  python -m plab.view task=Torus variant=2 --output torus.html
"""


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments after the program's name; those of the process by default.

    Returns:
        Exit code: 0.
    """
    _run(_parse(argv))
    return 0


def _run(arguments: argparse.Namespace) -> None:
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


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments, checked as far as can be done without simulating."""
    parser = make_parser(_USAGE, "the page")
    parser.add_argument(
        "--output", type=folder, metavar="FILE", help="by default a .html named like the result or the task"
    )
    arguments = parser.parse_args(argv)
    usual = settle(arguments, ".html")
    arguments.output = arguments.output or usual
    if arguments.output.suffix.lower() != ".html":
        raise RenderError(f"cannot write {arguments.output}: its suffix must be .html")
    require_writable(arguments.output)
    return arguments
