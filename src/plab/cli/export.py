"""The rollout of a run's best actions, or of the best actions known for a task, for ParaView or Blender.

plab export RESULT_FILE [--format vtk|ply] [--output FOLDER]
plab export KEY=VALUE ... [--format vtk|ply] [--output FOLDER]

What is written into the folder:
  vtk   for ParaView: particles, surface of the plasticine, manipulators, each a series (.pvd) over time
  ply   for Blender: surface of the plasticine and manipulators, with colours, a file per frame
Both hold the target's surface, too.

EXAMPLES
  plab export results/Rope-v1/adam/seed0-12ab34cd.h5
  plab export task=Torus variant=2 --format ply --output torus
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from plab.cli.arguments import folder, require_writable
from plab.cli.command import command_line
from plab.cli.rollouts import make_parser, rollout, settle
from plab.render.graphics import RenderError, require_packages

__all__ = ["main"]


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    arguments = _parse(argv)
    require_packages("exports need", {"pyvista": "PyVista"}, "render")
    # Imported here: it loads the simulator, for which no mistake above should have to wait.
    from plab.export.files import write_ply, write_vtk
    from plab.render.recording import record_with_motion

    output: Path = arguments.output
    recording = record_with_motion(*rollout(arguments))
    try:
        output.mkdir(parents=True, exist_ok=True)
        (write_vtk if arguments.format == "vtk" else write_ply)(recording, output, arguments.every or 1)
    except OSError as error:
        raise RenderError(f"cannot write {output}: {error.strerror or error}") from error
    print(output)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """Return the arguments, checked as far as can be done without simulating."""
    parser = make_parser("export", __doc__, "the series")
    add = parser.add_argument
    add("--format", choices=("vtk", "ply"), default="vtk", help="vtk unless given")
    add("--output", type=folder, metavar="FOLDER", help="by default named like the result or the task")
    arguments = parser.parse_intermixed_args(argv)
    settle(arguments, f"-{arguments.format}")
    output = arguments.output
    require_writable(output / "target")
    if output.is_dir() and any(output.iterdir()):
        raise RenderError(f"{output} is not empty: remove it, or choose another folder with --output")
    return arguments
