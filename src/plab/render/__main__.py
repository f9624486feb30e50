"""The command line of pictures: ``python -m plab.render task=Torus variant=2 --output torus.gif``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from omegaconf import OmegaConf

from plab.arguments import positive, to_write
from plab.config import ConfigError, choices, load_config
from plab.examples import EXAMPLES, resolve
from plab.render.graphics import RenderError, require_graphics
from plab.results import ResultsError
from plab.results.loading import readable_rows
from plab.results.schema import ARCHIVE_SUFFIX
from plab.scene import SceneError
from plab.selection import SelectionError, one_protocol, select
from plab.targets import TargetError

__all__ = ["main"]

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

_USAGE = """\
python -m plab.render RESULT_FILE [--output FILE]
python -m plab.render FOLDER | ARCHIVE | example [task=... method=...] [--output FILE]
python -m plab.render KEY=VALUE ... [--output FILE]
python -m plab.render --contact-sheet FILE [KEY=VALUE ...]

Draws the best actions of a run, those of the run with the highest score in a folder or an archive, the best
actions known for a task, or start and target of every task and variant.

The suffix of FILE decides what is written:
  .png         start, target and the rollout's end, side by side
  .gif, .mp4   the rollout, with the target's ghost in it

EXAMPLES
  python -m plab.render results/Rope-v1/adam/seed0-12ab34cd.h5
  python -m plab.render example task=Rope method=adam --output rope.gif
  python -m plab.render task=Torus variant=2 --output torus.gif
"""

_FRAME = (480, 360)
_CELL = (360, 150)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments after the program's name; those of the process by default.

    Returns:
        Exit code: 0, 2 for a mistake of the user's, 130 after Ctrl-C.
    """
    try:
        _run(_parse(argv))
    except (RenderError, ConfigError, SceneError, TargetError) as error:
        return _complain(str(error), EXIT_USER_ERROR)
    except KeyboardInterrupt:
        return _complain("stopped", EXIT_INTERRUPTED)
    except SystemExit as stop:
        # argparse leaves this way after --help.
        return stop.code if isinstance(stop.code, int) else 0
    return 0


def _run(arguments: argparse.Namespace) -> None:
    require_graphics()
    # Imported here, as below: they load the simulator, for which no mistake above should have to wait.
    from plab.render.pictures import check_output
    from plab.sim import DeviceError, SimulationError

    check_output(arguments.output)
    try:
        (_draw_contact_sheet if arguments.contact_sheet else _draw_rollout)(arguments)
    except (ResultsError, DeviceError, SimulationError) as error:
        raise RenderError(str(error)) from error
    print(arguments.output)


def _draw_rollout(arguments: argparse.Namespace) -> None:
    from plab.render import recording
    from plab.render.pictures import save

    if arguments.result:
        cfg, actions = recording.result(arguments.result)
    else:
        cfg = arguments.config
        actions = recording.demonstration(cfg)
    save(recording.record(cfg, actions), arguments.output, arguments.size or _FRAME, arguments.every)


def _draw_contact_sheet(arguments: argparse.Namespace) -> None:
    from plab.progress import show_progress
    from plab.render.pictures import save_contact_sheet
    from plab.render.recording import starts

    tasks = choices("task", arguments.config_dir)
    rows = {}
    with show_progress("contact sheet", 0, len(tasks)) as report:
        for number, (task, path) in enumerate(tasks.items(), start=1):
            variants = OmegaConf.load(path).variants
            words = [[f"task={task}", f"variant={variant}", *arguments.overrides] for variant in variants]
            cfgs = [load_config(each, arguments.config_dir) for each in words]
            if cfgs:
                rows[task] = starts(cfgs)
            report(number, task)
    save_contact_sheet(rows, arguments.output, arguments.size or _CELL)


# -------------------------------------------------------------------------------------------------- arguments


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments, checked as far as can be done without drawing.

    Adds ``result``, the result file or None; ``overrides``, the other words; ``config``, their configuration
    where a rollout is to be drawn; ``output`` where it was not given.
    """
    arguments = _parser().parse_args(argv)
    arguments.overrides = [word for word in arguments.what if "=" in word]
    files = [word for word in arguments.what if "=" not in word]
    arguments.result = Path(files[0]) if files else None
    if arguments.contact_sheet:
        given = [word for word in arguments.overrides if word.startswith(("task=", "variant="))]
        if files or given or arguments.output:
            unwanted = (*files, *given, "--output")[0]
            raise RenderError(f"--contact-sheet FILE shows all tasks and variants: leave out '{unwanted}'")
        if arguments.contact_sheet.suffix.lower() != ".png":
            raise RenderError(f"cannot write {arguments.contact_sheet}: a contact sheet is a .png")
        arguments.output = arguments.contact_sheet
    elif len(files) == 1 and _holds_many(files[0]):
        arguments.result, name = _best(files[0], arguments.overrides)
        arguments.output = arguments.output or Path(f"{name}.png")
    elif len(files) > 1 or (files and arguments.overrides):
        raise RenderError(f"give one result file or overrides (KEY=VALUE), not '{' '.join(arguments.what)}'")
    elif files:
        arguments.output = arguments.output or arguments.result.with_suffix(".png")
    elif arguments.overrides:
        cfg = arguments.config = load_config(arguments.overrides, arguments.config_dir)
        arguments.output = arguments.output or Path(f"{cfg.task.name}-v{cfg.variant}.png")
    else:
        raise RenderError("say what to draw: a result file, or a task such as task=Torus; --help explains")
    try:
        to_write(str(arguments.output))
    except argparse.ArgumentTypeError as error:
        raise RenderError(str(error)) from None
    return arguments


def _holds_many(source: str) -> bool:
    """Return whether a word stands for a folder or an archive of results."""
    return source in EXAMPLES or source.endswith(ARCHIVE_SUFFIX) or Path(source).is_dir()


def _best(source: str, words: Sequence[str]) -> tuple[Path, str]:
    """Return place and name of the finished run with the highest score, of those that the words choose."""
    names = ("task", "variant", "method", "seed")
    try:
        chosen = select(words, names)
        rows = [row for row in readable_rows(resolve(source))[0] if row.values["status"] == "finished"]
        rows = [row for row in rows if chosen(row.values, row.config)]
        one_protocol(row.config for row in rows)
    except (ResultsError, SelectionError) as error:
        raise RenderError(str(error)) from error
    if not rows:
        raise RenderError(f"there is no finished run to draw in {source}: no run fits")
    best = max(rows, key=lambda row: row.values["score"])
    task, variant, method, seed = (best.values[name] for name in names)
    return best.path, f"{task}-v{variant}-{method}-seed{seed}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(usage=_USAGE, allow_abbrev=False)
    add = parser.add_argument
    add("what", nargs="*", metavar="RESULTS | KEY=VALUE", help="keys are those of python -m plab.run")
    add("--output", type=Path, metavar="FILE", help="by default a .png named like the result or the task")
    add("--contact-sheet", type=Path, metavar="FILE", help="a .png")
    add("--size", type=_size, metavar="WxH", help="pixels of a frame, 480x360 unless given, or of a cell")
    add("--every", type=positive, default=1, metavar="K", help="a film has a frame every K environment steps")
    add("--config-dir", metavar="FOLDER", help="folder with tasks of your own, as for python -m plab.run")

    def refuse(message: str) -> NoReturn:
        raise RenderError(message)

    parser.error = refuse  # type: ignore[method-assign]
    return parser


def _size(text: str) -> tuple[int, int]:
    """Read a size such as 480x360; H.264 needs even numbers."""
    numbers = [int(number) for number in text.split("x") if number.isdecimal()]
    if len(numbers) != 2 or min(numbers) < 16 or any(number % 2 for number in numbers):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a size such as 480x360, of even numbers from 16 on"
        )
    return numbers[0], numbers[1]


def _complain(message: str, code: int) -> int:
    print(f"plab: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
