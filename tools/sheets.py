"""Pictures of all tasks for the documentation.

python tools/sheets.py docs/images/contact_sheet.png     start and target of every task and variant
python tools/sheets.py docs/images/film_strip.jpg        frames of the best known actions for every task
"""

import sys
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image

from plab.config import load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.render.camera import scene_camera
from plab.render.graphics import require_graphics
from plab.render.pictures import tiled
from plab.render.renderer import Renderer
from plab.render.rollouts import RecordedRollout, demonstration, record


def frames(words: list[str], size: tuple[int, int], count: int) -> tuple[RecordedRollout, list[np.ndarray]]:
    """Return a demonstration with frames at equal time intervals, or with initial and target frames only."""
    cfg = load_config(words)
    one = record(cfg, demonstration(cfg))
    x, mass = one.x[[0, -1]].reshape(-1, 3), one.target_mass
    camera = scene_camera(one.scene, mass, size, x, one.poses[::5])
    with closing(Renderer(one.scene, mass, size, camera)) as renderer:
        steps = np.linspace(0, len(one.x) - 1, count).round().astype(int)
        shown = [renderer.frame(one.x[step], one.poses[step]) for step in steps]
        return one, [*shown, renderer.target(one.poses[0])] if count == 1 else shown


def main(path: Path) -> None:
    """Write the contact sheet for a PNG file, the film strip for a JPEG file."""
    require_graphics()
    sheet, tiles = path.suffix == ".png", []
    for task in suite_tasks():
        for variant in SUITE_VARIANTS[: None if sheet else 1]:
            words = [f"task={task}", f"variant={variant}"]
            one, pictures = frames(words, (180, 150) if sheet else (240, 180), 1 if sheet else 4)
            caption = f"{task}, variant {variant}" + ("" if sheet else f": score {one.score:.2f}")
            tiles.append((np.concatenate(pictures, axis=1), caption))
    picture = tiled(tiles, len(SUITE_VARIANTS) if sheet else 2)
    if sheet:
        picture = picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1)
    picture.save(path, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
