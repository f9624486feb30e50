"""Pictures and films of a run's best actions, of the best actions known for a task, or of all tasks.

plab render RESULT_FILE [--output FILE]
plab render (FOLDER | ARCHIVE | example) ... [task=... method=...] [--output FILE]
plab render KEY=VALUE ... [--output FILE]
plab render --contact-sheet FILE [KEY=VALUE ...]
plab render --film-strip FILE [KEY=VALUE ...]

Draws the best actions of a run, those of the run with the highest score in folders and archives, the best
actions known for a task, start and target of every task and variant, or a few frames of the best actions
known for every task.

The suffix of FILE decides what is written:
  .png         start, target and the rollout's end, side by side
  .gif, .mp4   the rollout, with the target's ghost in it

EXAMPLES
  plab render results/Rope-v1/adam/seed0-12ab34cd.h5
  plab render example task=Rope method=adam --output rope.gif
  plab render task=Torus variant=2 --output torus.gif
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from plab.cli.arguments import folder, require_writable
from plab.cli.command import command_line
from plab.cli.rollouts import WITHOUT_EFFECT, make_parser, rollout, settle
from plab.config import choices, load_config
from plab.config.words import require_effect
from plab.render.graphics import RenderError, require_graphics

__all__ = ["main"]

_FRAME = (480, 360)
_CELL = (360, 150)
_STRIP_FRAME = (240, 180)

_LARGEST = 4096
"""Pixels of a frame's side, at most: what every OpenGL can draw, and H.264 can hold."""


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    arguments = _parse(argv)
    require_graphics()
    # Imported here, as below: they load the simulator, for which no mistake above should have to wait.
    from plab.render.pictures import check_output

    if not arguments.all_tasks:
        check_output(arguments.output)
    arguments.draw(arguments)
    print(arguments.output)


def _draw_rollout(arguments: argparse.Namespace) -> None:
    from plab.render.pictures import save
    from plab.render.recording import record

    save(record(*rollout(arguments)), arguments.output, arguments.size or _FRAME, arguments.every or 1)


def _draw_contact_sheet(arguments: argparse.Namespace) -> None:
    from plab.progress import show_progress
    from plab.render.pictures import save_contact_sheet
    from plab.render.recording import starts

    tasks = choices("task", arguments.config_dir)
    rows = {}
    with show_progress("contact sheet", 0, len(tasks)) as report:
        for number, (task, path) in enumerate(tasks.items(), start=1):
            variants = OmegaConf.load(path).variants
            words = [[f"task={task}", f"variant={variant}", *arguments.what] for variant in variants]
            cfgs = [load_config(each, arguments.config_dir) for each in words]
            if cfgs:
                rows[task] = starts(cfgs)
            report(number, task)
    save_contact_sheet(rows, arguments.output, arguments.size or _CELL)


def _draw_film_strip(arguments: argparse.Namespace) -> None:
    from plab.progress import show_progress
    from plab.render.pictures import save_film_strip
    from plab.render.recording import demonstration, record

    tasks = choices("task", arguments.config_dir)
    recordings = []
    with show_progress("film strip", 0, len(tasks)) as report:
        for number, task in enumerate(tasks, start=1):
            cfg = load_config([f"task={task}", *arguments.what], arguments.config_dir)
            recordings.append(record(cfg, demonstration(cfg)))
            report(number, task)
    save_film_strip(recordings, arguments.output, arguments.size or _STRIP_FRAME)


# -------------------------------------------------------------------------------------------------- arguments


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """Return the arguments, checked as far as can be done without drawing.

    Adds ``draw``, what carries them out; ``all_tasks``, whether it shows all tasks; and what
    :func:`plab.cli.rollouts.settle` adds.
    """
    parser = make_parser("render", __doc__, "a film")
    add = parser.add_argument
    add("--output", type=folder, metavar="FILE", help="by default a .png named like the result or the task")
    add("--contact-sheet", type=folder, metavar="FILE", help="a .png")
    add("--film-strip", type=folder, metavar="FILE", help="a .jpg")
    add("--size", type=_size, metavar="WxH", help="pixels of a frame, 480x360 unless given, or of a cell")
    arguments = parser.parse_intermixed_args(argv)
    for option, path, suffix, draw in (
        ("--contact-sheet", arguments.contact_sheet, ".png", _draw_contact_sheet),
        ("--film-strip", arguments.film_strip, ".jpg", _draw_film_strip),
    ):
        if path:
            _check_sheet(arguments, option, path, suffix)
            arguments.output, arguments.draw, arguments.all_tasks = path, draw, True
            require_writable(path)
            return arguments
    settle(arguments, ".png")
    require_writable(arguments.output)
    arguments.draw, arguments.all_tasks = _draw_rollout, False
    return arguments


def _check_sheet(arguments: argparse.Namespace, option: str, path: Path, suffix: str) -> None:
    """Refuse what goes with no picture of all tasks."""
    require_effect([word for word in arguments.what if "=" in word], WITHOUT_EFFECT, "a picture")
    variants = option == "--contact-sheet"
    own = ("task=", "variant=") if variants else ("task=",)
    unwanted = [word for word in arguments.what if "=" not in word or word.startswith(own)]
    unwanted += ["--output"] if arguments.output else []
    unwanted += ["--film-strip"] if variants and arguments.film_strip else []
    if unwanted:
        shown = "tasks and variants" if variants else "tasks"
        raise RenderError(f"{option} FILE shows all {shown}: leave out '{unwanted[0]}'")
    if path.suffix.lower() != suffix:
        raise RenderError(f"cannot write {path}: a {option[2:].replace('-', ' ')} is a {suffix}")


def _size(text: str) -> tuple[int, int]:
    """Read a size such as 480x360; H.264 needs even numbers."""
    numbers = [int(number) for number in text.split("x") if number.isdecimal()]
    if len(numbers) != 2 or any(number % 2 or not 16 <= number <= _LARGEST for number in numbers):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a size such as 480x360, of even numbers from 16 to {_LARGEST}"
        )
    return numbers[0], numbers[1]
