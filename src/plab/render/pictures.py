"""Picture files: strips of initial state, target and final state, films, and sets of both for the results
page."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from plab.config import ConfigError
from plab.files import UNFINISHED, complete_folder
from plab.progress import show_progress
from plab.render.camera import scene_camera
from plab.render.graphics import RenderError, require_graphics
from plab.render.renderer import INK, PAPER, Renderer
from plab.render.rollouts import RecordedRollout, record, record_all, result
from plab.results import ResultsError
from plab.scenes import SceneError
from plab.sim import DeviceError, SimulationError
from plab.targets import TargetError

STEPS_PER_SECOND = 20
"""Environment steps per second of a film."""

SUFFIXES = (".png", ".gif", ".mp4")
"""Suffixes of supported files: a strip of pictures, or a film."""

_HOLD = 1.0  # duration of the last frame of a film [s]
_FILM_COLORS = 96  # of a GIF
_SHEET_COLORS = 256
_STRIP_FRAMES = 4  # of a task in the film strip
_SET_EVERY = 2  # environment steps from one frame to the next, of a set

_PAGE_SIZE = (480, 360)
_RENDER_ERRORS = (
    *(RenderError, ResultsError, ConfigError, SceneError, TargetError),
    *(DeviceError, SimulationError),
)


Wanted = Mapping[Path, Mapping[str, tuple[Path, bool]]]
"""By folder and picture name: result file, and whether to make a film."""


def check_output(path: Path) -> None:
    """Raise an error for unsupported files, before anything is computed.

    Raises:
        RenderError: If the suffix is not supported, or a required package is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RenderError(f"cannot write {path}: its suffix must be one of {', '.join(SUFFIXES)}")
    if suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise RenderError("MP4 needs imageio-ffmpeg, which is not installed: pip install 'plab[render]'")


def save(recording: RecordedRollout, path: Path, size: tuple[int, int], every: int = 1) -> None:
    """Write a recording: a strip as PNG, a film as GIF or MP4.

    Args:
        recording: The rollout.
        path: File to write; see :func:`check_output`.
        size: Width and height of a frame [pixels]; even numbers for MP4.
        every: Environment steps from one frame of a film to the next.

    Raises:
        RenderError: If the file cannot be written.
    """
    write = {".png": _save_png, ".gif": _save_gif, ".mp4": _save_mp4}[path.suffix.lower()]
    with _renderer(recording, size) as renderer, _writing(path) as fresh:
        write(recording, renderer, every, fresh)


def save_set(
    recordings: Mapping[str, RecordedRollout], folder: Path, size: tuple[int, int], filmed: Collection[str]
) -> None:
    """Write pictures of several rollouts of one configuration with a common camera.

    Writes ``start.webp`` and ``target.webp``, for each rollout its last state as ``<name>.webp``, and of
    some, where imageio-ffmpeg is installed, a film ``<name>.mp4``.

    Args:
        recordings: The rollouts by name.
        folder: Folder to write to.
        size: Width and height of a frame [pixels]; even numbers.
        filmed: Names of the rollouts with a film.

    Raises:
        RenderError: If a file cannot be written.
    """
    shown = [*recordings.values()]
    films = find_spec("imageio_ffmpeg") is not None
    for name, one in recordings.items():
        with _renderer(one, size, shown) as renderer, _writing(folder / name):
            pictures = {name: renderer.frame(one.x[-1], one.poses[-1])}
            if one is shown[0]:
                pictures["start"] = renderer.frame(one.x[0], one.poses[0])
                pictures["target"] = renderer.target(one.poses[0])
            for what, picture in pictures.items():
                Image.fromarray(picture).save(folder / f"{what}.webp", quality=86)
            if films and name in filmed:
                _save_mp4(one, renderer, _SET_EVERY, folder / f"{name}.mp4")


def save_contact_sheet(
    rows: Mapping[str, Sequence[RecordedRollout]], path: Path, size: tuple[int, int]
) -> None:
    """Write one picture of many tasks as PNG.

    Args:
        rows: One row per task with the initial state and the target of each variant.
        path: File to write.
        size: Width and height of a cell [pixels]; start and target share it.

    Raises:
        RenderError: If the file cannot be written.
    """
    tiles = []
    for one in (recording for recordings in rows.values() for recording in recordings):
        with _renderer(one, (size[0] // 2, size[1])) as renderer:
            pair = renderer.frame(one.x[0], one.poses[0]), renderer.target(one.poses[0])
        tiles.append((np.concatenate(pair, axis=1), f"{one.task}, variant {one.variant}"))
    with _writing(path) as fresh:
        sheet = _tiled(tiles, max(map(len, rows.values())))
        _with_palette(sheet, _SHEET_COLORS).save(fresh, optimize=True)


def save_film_strip(recordings: Sequence[RecordedRollout], path: Path, size: tuple[int, int]) -> None:
    """Write one picture of many rollouts as JPEG: of each some frames, at equal distances in time.

    Args:
        recordings: The rollouts.
        path: File to write.
        size: Width and height of a frame [pixels].

    Raises:
        RenderError: If the file cannot be written.
    """
    tiles = []
    for one in recordings:
        steps = np.linspace(0, len(one.x) - 1, _STRIP_FRAMES).round().astype(int)
        with _renderer(one, size) as renderer:
            frames = [renderer.frame(one.x[step], one.poses[step]) for step in steps]
        caption = f"{one.task}, variant {one.variant}: score {one.score:.2f}"
        tiles.append((np.concatenate(frames, axis=1), caption))
    with _writing(path) as fresh:
        _tiled(tiles, 2).save(fresh, quality=88, optimize=True)


@contextmanager
def _renderer(
    recording: RecordedRollout, size: tuple[int, int], seen: Sequence[RecordedRollout] = ()
) -> Iterator[Renderer]:
    """Open a renderer of a rollout, with it or others of the same configuration in view."""
    scene, mass, seen = recording.scene, recording.target_mass, seen or [recording]
    x = np.concatenate([one.x[[0, -1]].reshape(-1, 3) for one in seen])
    poses = np.concatenate([one.poses[::5] for one in seen])
    with closing(Renderer(scene, mass, size, scene_camera(scene, mass, size, x, poses))) as renderer:
        yield renderer


@contextmanager
def _writing(path: Path) -> Iterator[Path]:
    """Create the folder of a file, and yield a temporary path that replaces the file on success."""
    fresh = path.with_name(f"{UNFINISHED}{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield fresh
        if fresh.exists():
            fresh.replace(path)
    except OSError as error:
        raise RenderError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        fresh.unlink(missing_ok=True)


# ---------------------------------------------------------------------------------------------------- formats


def _save_png(recording: RecordedRollout, renderer: Renderer, _every: int, path: Path) -> None:
    first, last, steps = recording.poses[0], recording.poses[-1], len(recording.x) - 1
    panels = [
        (renderer.frame(recording.x[0], first), f"{recording.task}, variant {recording.variant}: start"),
        (renderer.target(first), "target"),
        (renderer.frame(recording.x[-1], last), f"after {steps} steps: score {recording.score:.2f}"),
    ]
    _tiled(panels, len(panels)).save(path, optimize=True)


def _save_gif(recording: RecordedRollout, renderer: Renderer, every: int, path: Path) -> None:
    frames = list(_frames(recording, renderer, every))
    # One palette for all frames, so that unchanged parts compress well.
    some = np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]])
    palette = _with_palette(Image.fromarray(some), _FILM_COLORS)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = [1000 * every // STEPS_PER_SECOND] * (len(images) - 1) + [round(1000 * _HOLD)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=False)


def _save_mp4(recording: RecordedRollout, renderer: Renderer, every: int, path: Path) -> None:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path), renderer.size, fps=STEPS_PER_SECOND / every, codec="libx264", quality=8, macro_block_size=2
    )
    with closing(writer):
        writer.send(None)
        for frame in _frames(recording, renderer, every):
            writer.send(np.ascontiguousarray(frame))
        for _ in range(round(_HOLD * STEPS_PER_SECOND / every) - 1):
            writer.send(np.ascontiguousarray(frame))
    try:
        imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:
        # ffmpeg leaves a part of the film without an error.
        raise OSError("the film is incomplete: is the disk full?") from None


def _frames(recording: RecordedRollout, renderer: Renderer, every: int) -> Iterator[np.ndarray]:
    last = len(recording.x) - 1
    for step in [*range(0, last, every), last]:
        yield renderer.frame(recording.x[step], recording.poses[step])


def _with_palette(picture: Image.Image, colors: int) -> Image.Image:
    return picture.quantize(colors, method=Image.Quantize.MAXCOVERAGE, kmeans=1)


def _tiled(tiles: Sequence[tuple[np.ndarray, str]], columns: int) -> Image.Image:
    """Return pictures of one size in rows, each above its caption."""
    height, width, _ = tiles[0][0].shape
    text = max(12, height // 22)
    size = columns * (width + text) - text, -(-len(tiles) // columns) * (height + 2 * text)
    sheet = Image.new("RGB", size, PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(text)
    for number, (picture, caption) in enumerate(tiles):
        left, top = number % columns * (width + text), number // columns * (height + 2 * text)
        sheet.paste(Image.fromarray(picture), (left, top))
        draw.text((left + width // 2, top + height + text), caption, fill=INK, font=font, anchor="mm")
    return sheet


# ------------------------------------------------------------------------------------------------------ runs


def draw_runs(wanted: Wanted, drawn: Callable[[], None]) -> None:
    """Render runs of many configurations, see :func:`save_set`; those with films first.

    Args:
        wanted: For each configuration the folder of its pictures, which must not exist and appears when it is
            complete; and the pictures to draw.
        drawn: Called when a folder is complete.

    Raises:
        RenderError: If rendering is not possible, a file cannot be written, or runs cannot be replayed; all
            other pictures are written.
    """
    require_graphics()
    troubles: list[str] = []
    for place in {folder.parent for folder in wanted}:
        # Leftover pictures of killed processes.
        for folder in place.glob(f"{UNFINISHED}*"):
            shutil.rmtree(folder, ignore_errors=True)
    filmed = {folder: [n for n, (_, film) in files.items() if film] for folder, files in wanted.items()}
    with show_progress("pictures", 0, len(wanted), plain_every=1) as report:
        for number, folder in enumerate(sorted(wanted, key=lambda one: -len(filmed[one])), start=1):
            try:
                made = _replayed({name: path for name, (path, _) in wanted[folder].items()})
            except _RENDER_ERRORS as error:
                troubles.append(f"{folder.name} cannot be replayed: {error}")
                continue
            with complete_folder(folder) as fresh:
                save_set(made, fresh, _PAGE_SIZE, filmed[folder])
            report(number, folder.name)
            drawn()
    if troubles:
        raise RenderError("; ".join(troubles))


def _replayed(files: Mapping[str, Path]) -> dict[str, RecordedRollout]:
    """Replay runs of one configuration by name; runs with the same settings share a simulator."""
    found = {name: result(path) for name, path in files.items()}
    alike: dict[str, list[str]] = defaultdict(list)
    for name, (cfg, actions) in found.items():
        sections = [asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
        alike[json.dumps([*sections, actions.shape])].append(name)
    made: dict[str, RecordedRollout] = {}
    for names in alike.values():
        cfgs, actions = zip(*(found[name] for name in names), strict=True)
        made |= zip(names, record_all(cfgs, np.stack(actions)), strict=True)
    return {name: made[name] for name in files}


def draw_strip(path: Path, picture: Path) -> None:
    """Replay a run and draw start, target and end side by side.

    Args:
        path: The result file.
        picture: PNG file to write.

    Raises:
        RenderError: If rendering is not possible, or the run cannot be replayed.
    """
    require_graphics()
    try:
        save(record(*result(path)), picture, _PAGE_SIZE)
    except _RENDER_ERRORS as error:
        raise RenderError(str(error)) from error
