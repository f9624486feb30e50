"""The commands ``plab render``, ``view`` and ``export`` for rollouts of runs or tasks."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from plab.cli.command import (
    Parser,
    command_line,
    finished_rows,
    folder,
    positive,
    sources_and_words,
    to_write,
)
from plab.config import choices, load_config
from plab.config.compose import check_overrides, check_sources
from plab.config.suite import EXTENSION_TASKS
from plab.errors import ArgumentError
from plab.render.graphics import RenderError, require_graphics, require_packages

_MAX_FRAME_SIZE = 4096
"""Largest frame width and height [pixels], supported by all OpenGL versions and by H.264."""


@command_line
def render(argv: Sequence[str]) -> None:
    """Draw a run's best actions, or the best known actions for a task.

    plab render RESULT_FILE [--output FILE]
    plab render (FOLDER | ARCHIVE | example) ... [task=... method=...] [--output FILE]
    plab render KEY=VALUE ... [--output FILE]

    For folders and archives, it shows the run with the highest score. The suffix of FILE selects the output:
      .png         start, target and the rollout's end, side by side
      .gif, .mp4   a film of the rollout, with the translucent target

    EXAMPLES
      plab render results/Rope-v1/adam/seed0-12ab34cd.h5
      plab render example task=Rope method=adam --output rope.gif
      plab render task=Torus variant=2 --output torus.gif
    """
    parser = _parser("plab render", render.__doc__, "a film")
    what = "output file (default: a .png named after the result or the task)"
    parser.add_argument("--output", type=folder, metavar="FILE", help=what)
    what = "size of a frame in pixels (default: 480x360)"
    parser.add_argument("--size", type=_size, default=(480, 360), metavar="WxH", help=what)
    options = parser.parse_intermixed_args(argv)
    path = resolve_rollout(options, ".png")
    to_write(path)
    require_graphics()
    # Imported here and below, because it loads the simulator, which the checks above do not need.
    from plab.render import pictures
    from plab.render.rollouts import record, rollout

    pictures.check_output(path)
    pictures.save(record(*rollout(options.source)), path, options.size, options.every or 1)
    print(path)


@command_line
def view(argv: Sequence[str]) -> None:
    """Write a page on which a run's best actions, or the best known actions for a task, are played in 3-D.

    plab view RESULT_FILE [--output FILE.html]
    plab view KEY=VALUE ... [--output FILE.html]
    plab view --gallery [KEY=VALUE ...] [--output FOLDER]     a page of every task, and index.html

    The page shows plasticine, manipulators and the translucent target in any browser. Space plays and pauses;
    arrow keys move by one step.

    EXAMPLES
      plab view results/Rope-v1/adam/seed0-12ab34cd.h5
      plab view task=Torus variant=2 --output torus.html
    """
    parser = _parser("plab view", view.__doc__, "the page")
    what = ".html file (default: named after the result or the task); with --gallery a folder (default: "
    what += "gallery)"
    parser.add_argument("--output", type=folder, metavar="FILE", help=what)
    what = "frames of the best known actions of every task"
    parser.add_argument("--gallery", action="store_true", help=what)
    what = "show plasticine as smooth surfaces instead of its particles"
    parser.add_argument("--surface", action="store_true", help=what)
    options = parser.parse_intermixed_args(argv)
    if options.gallery:
        if unwanted := [word for word in options.what if "=" not in word or word.startswith("task=")]:
            raise ArgumentError(f"all tasks are shown: omit '{unwanted[0]}'")
        output = (options.output or Path("gallery")) / "index.html"
    else:
        output = resolve_rollout(options, ".html")
    if output.suffix.lower() != ".html":
        raise RenderError(f"cannot write {output}: its suffix must be .html")
    to_write(output)
    require_packages("the viewer needs", {"k3d": "K3D-jupyter", "pyvista": "PyVista"}, "view")
    from plab.render.rollouts import record, rollout
    from plab.report.page import render as html
    from plab.results.run_file import replace_file
    from plab.view.page import page

    if options.gallery:
        pages = []
        for task in (one for one in choices("task", options.config_dir) if one not in EXTENSION_TASKS):
            cfg = load_config([f"task={task}", *options.what], options.config_dir)
            recording, file = record(*rollout(cfg), motion=True), f"{task}-v{cfg.variant}.html"
            replace_file(output.with_name(file), page(recording, options.every, surface=options.surface))
            pages.append((task, file, recording.score))
        replace_file(output, html("gallery.html", "plab.view", pages=pages))
    else:
        recording = record(*rollout(options.source), motion=True)
        replace_file(output, page(recording, options.every, surface=options.surface))
    print(output)


@command_line
def export(argv: Sequence[str]) -> None:
    """Write a run's best actions, or the best known actions for a task, for ParaView or Blender.

    plab export RESULT_FILE [--format vtk|ply] [--output FOLDER]
    plab export KEY=VALUE ... [--format vtk|ply] [--output FOLDER]

    Content of the folder:
      vtk   for ParaView: particles, surface of the plasticine, manipulators, each a series (.pvd) over time
      ply   for Blender: surface of the plasticine and manipulators, with colours, a file per frame
    Both include the target's surface.

    EXAMPLES
      plab export results/Rope-v1/adam/seed0-12ab34cd.h5
      plab export task=Torus variant=2 --format ply --output torus
    """
    parser = _parser("plab export", export.__doc__, "the series")
    what = "format of the files (default: vtk)"
    parser.add_argument("--format", choices=("vtk", "ply"), default="vtk", help=what)
    what = "folder (default: named after the result or the task)"
    parser.add_argument("--output", type=folder, metavar="FOLDER", help=what)
    options = parser.parse_intermixed_args(argv)
    output = resolve_rollout(options, f"-{options.format}")
    to_write(output / "target")
    if output.is_dir() and any(output.iterdir()):
        raise RenderError(f"{output} is not empty: remove it, or choose another folder with --output")
    require_packages("exports need", {"pyvista": "PyVista"}, "render")
    from plab.export.writers import write_ply, write_vtk
    from plab.files import complete_folder
    from plab.render.rollouts import record, rollout

    recording = record(*rollout(options.source), motion=True)
    with complete_folder(output) as fresh:
        (write_vtk if options.format == "vtk" else write_ply)(recording, fresh, options.every or 1)
    print(output)


# ---------------------------------------------------------------------------------------- choice of a rollout


def _parser(name: str, text: str | None, every: str) -> Parser:
    parser = Parser(name, text)
    add = parser.add_argument
    add("what", nargs="*", metavar="RESULTS | KEY=VALUE", help="keys are those of plab run")
    add("--every", type=positive, metavar="K", help=f"{every} has a frame every K environment steps")
    add("--config-dir", metavar="FOLDER", help="folder with your own tasks and modules, as for plab run")
    return parser


def resolve_rollout(options: argparse.Namespace, ending: str) -> Path:
    """Find the rollout without simulating.

    Sets ``source``: the result file, or the configuration if there is no result; and a default ``output``:
    beside the result (but not inside an archive) with the suffix ``ending``, or named after the task.

    Returns:
        The output.

    Raises:
        RenderError: If nothing is selected, or both a run and a task are.
        plab.config.ConfigError: If the configuration is invalid.
    """
    # Imported here and below, because h5py and pandas are slow to load.
    from plab.results.run_file import ARCHIVE_SUFFIX, split_archive

    sources, words = sources_and_words(options.what, default=None)
    check_overrides([], options.config_dir)
    if sources and all(str(one).endswith(ARCHIVE_SUFFIX) or one.is_dir() for one in sources):
        # Ties are broken as on the results page.
        found = finished_rows(sources, words)
        best = min(found, key=lambda row: (-row.values["score"], row.values["config_hash"]))
        options.source, own = best.path, best.values
        usual = Path(f"{own['task']}-v{own['variant']}-{own['method']}-seed{own['seed']}{ending}")
    elif len(sources) > 1 or (sources and words):
        given = " ".join(options.what)
        raise RenderError(f"name either one result file or overrides (KEY=VALUE), not '{given}'")
    elif sources:
        (path,) = (options.source,) = sources
        usual = (Path() if split_archive(path) else path.parent) / (path.stem + ending)
    elif words:
        cfg = options.source = load_config(words, options.config_dir)
        check_sources(cfg)
        usual = Path(f"{cfg.task.name}-v{cfg.variant}{ending}")
    else:
        raise RenderError("nothing to show: name a result file, or a task such as task=Torus; see --help")
    options.output = options.output or usual
    return options.output


def _size(text: str) -> tuple[int, int]:
    """Read a size such as 480x360; H.264 needs even numbers."""
    numbers = [int(number) for number in text.split("x") if number.isdecimal()]
    if len(numbers) != 2 or any(number % 2 or not 16 <= number <= _MAX_FRAME_SIZE for number in numbers):
        what = f"a size such as 480x360, of even numbers from 16 to {_MAX_FRAME_SIZE}"
        raise argparse.ArgumentTypeError(f"'{text}' is not {what}")
    return numbers[0], numbers[1]
