"""Picture files: strips of initial, target and final state, films, and sets for the results page."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from plab.config import Config
from plab.errors import PlabError
from plab.files import UNFINISHED, complete_folder
from plab.problem import Problem
from plab.progress import show_progress
from plab.render.camera import scene_camera
from plab.render.graphics import RenderError, require_graphics
from plab.render.renderer import INK, PAPER, Renderer
from plab.render.rollouts import RecordedRollout, record, result
from plab.results.run_file import replace_file

STEPS_PER_SECOND = 20
"""Environment steps per second of a film."""

_HOLD = 1.0  # duration of the last frame of a film [s]
_FILM_COLORS = 96  # of a GIF
_SET_EVERY, _SET_SIZE = 2, (480, 360)  # of a set: environment steps between frames, pixels


def check_output(path: Path) -> None:
    """Raise RenderError if the suffix is not supported, or a package is not installed."""
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise RenderError(f"cannot write {path}: its suffix must be one of {', '.join(_WRITERS)}")
    if suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise RenderError("MP4 needs imageio-ffmpeg, which is not installed: pip install 'plab[render]'")


def save(recording: RecordedRollout, path: Path, size: tuple[int, int], every: int = 1) -> None:
    """Write a recording: a strip as PNG, a film as GIF or MP4.

    Args:
        recording: The rollout.
        path: File to write; see :func:`check_output`.
        size: Width and height of a frame [pixels]; even numbers for MP4.
        every: Environment steps between frames of a film.
    """
    # In another folder, so that the file appears complete.
    with _renderer(recording, size) as renderer, TemporaryDirectory() as place:
        fresh = Path(place, path.name)
        _WRITERS[path.suffix.lower()](recording, renderer, every, fresh)
        replace_file(path, fresh.read_bytes())


def save_set(recording: RecordedRollout, folder: Path, *, film: bool) -> None:
    """Write pictures of a rollout: ``start.webp``, ``target.webp`` and the
    final state ``end.webp``; and a film ``end.mp4``, if requested and imageio-ffmpeg is installed."""
    first, last = recording.poses[0], recording.poses[-1]
    with _renderer(recording, _SET_SIZE) as renderer:
        pictures = {"start": renderer.frame(recording.x[0], first), "target": renderer.target(first)}
        pictures["end"] = renderer.frame(recording.x[-1], last)
        for what, picture in pictures.items():
            Image.fromarray(picture).save(folder / f"{what}.webp", quality=86)
        if film and find_spec("imageio_ffmpeg") is not None:
            _save_mp4(recording, renderer, _SET_EVERY, folder / "end.mp4")


def _renderer(recording: RecordedRollout, size: tuple[int, int]) -> closing[Renderer]:
    """Open a renderer whose camera shows a whole rollout, for a ``with`` block."""
    scene, mass = recording.scene, recording.target_mass
    camera = scene_camera(scene, mass, size, recording.x[[0, -1]], recording.poses[::5])
    return closing(Renderer(scene, mass, size, camera))


# ---------------------------------------------------------------------------------------------------- formats


def _save_png(recording: RecordedRollout, renderer: Renderer, _every: int, path: Path) -> None:
    first, last, steps = recording.poses[0], recording.poses[-1], len(recording.x) - 1
    panels = [
        (
            renderer.frame(recording.x[0], first),
            f"{recording.scene.name}, variant {recording.variant}: start",
        ),
        (renderer.target(first), "target"),
        (renderer.frame(recording.x[-1], last), f"after {steps} steps: score {recording.score:.2f}"),
    ]
    tiled(panels, len(panels)).save(path, optimize=True)


def _save_gif(recording: RecordedRollout, renderer: Renderer, every: int, path: Path) -> None:
    frames = list(_frames(recording, renderer, every))
    # One palette for all frames, so that unchanged parts compress well.
    some = np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]])
    palette = Image.fromarray(some).quantize(_FILM_COLORS, method=Image.Quantize.MAXCOVERAGE, kmeans=1)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = [1000 * every // STEPS_PER_SECOND] * (len(images) - 1) + [round(1000 * _HOLD)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=False)


def _save_mp4(recording: RecordedRollout, renderer: Renderer, every: int, path: Path) -> None:
    import imageio_ffmpeg

    options = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
    writer = imageio_ffmpeg.write_frames(str(path), renderer.size, fps=STEPS_PER_SECOND / every, **options)
    try:
        with closing(writer):
            writer.send(None)
            for frame in _frames(recording, renderer, every):
                writer.send(np.ascontiguousarray(frame))
            for _ in range(round(_HOLD * STEPS_PER_SECOND / every) - 1):
                writer.send(np.ascontiguousarray(frame))
        imageio_ffmpeg.count_frames_and_secs(str(path))
    except (OSError, RuntimeError):
        # ffmpeg may write only part of the film without reporting an error.
        raise OSError("the film is incomplete; the disk may be full") from None


_WRITERS = {".png": _save_png, ".gif": _save_gif, ".mp4": _save_mp4}
"""Functions that write a strip of pictures, or a film, by suffix."""


def _frames(recording: RecordedRollout, renderer: Renderer, every: int) -> Iterator[np.ndarray]:
    last = len(recording.x) - 1
    for step in [*range(0, last, every), last]:
        yield renderer.frame(recording.x[step], recording.poses[step])


def tiled(tiles: Sequence[tuple[np.ndarray, str]], columns: int) -> Image.Image:
    """Return pictures of equal size in rows, each above its caption."""
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


def draw_runs(
    wanted: Mapping[Path, tuple[Path, bool]], drawn: Callable[[], None], build: Callable[[Config], Problem]
) -> None:
    """Render runs, see :func:`save_set`, in the order of their folders.

    Args:
        wanted: Result file, and whether to make a film, by folder. Folders must not exist, and appear when
            they are complete.
        drawn: Callback after each completed folder.
        build: Function that returns the problem of a configuration.

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
    with show_progress("pictures", 0, len(wanted), plain_every=1) as report:
        for number, (folder, (path, film)) in enumerate(sorted(wanted.items()), start=1):
            try:
                cfg, actions = result(path)
                recording = record(cfg, actions, build(cfg))
            except PlabError as error:
                troubles.append(f"{folder.name} cannot be replayed: {error}")
                continue
            with complete_folder(folder) as fresh:
                save_set(recording, fresh, film=film)
            report(number, folder.name)
            drawn()
    if troubles:
        more = f"; and {len(troubles) - 1} more runs" if len(troubles) > 1 else ""
        raise RenderError(troubles[0] + more)
