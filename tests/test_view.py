"""3-D viewer: page content, command line, notebook frame, and a real browser."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import json
import re
import urllib.parse
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from browsing import browsing
from plab import results
from plab.cli.rollouts import view as main
from plab.config import build_scene, load_config
from plab.config.suite import suite_tasks
from plab.demonstrations import known_actions
from plab.objective import spread_mass
from plab.render import graphics
from plab.render.rollouts import RecordedRollout
from plab.scenes import sample_particles
from plab.view import Viewer, show
from toy_runner import COARSE

shapes = pytest.importorskip("plab.render.shapes")
msgpack = pytest.importorskip("msgpack")
viewer = pytest.importorskip("plab.view.page")

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")

ACTIONS = np.full((3, 6), 0.5)
WAY = 0.02 * np.arange(4)[:, None, None] * np.eye(8)[1]


@pytest.fixture(scope="module")
def recording() -> RecordedRollout:
    """Everything rises by 0.02 per step; nothing is simulated."""
    scene = build_scene(load_config(["task=Rope", *COARSE]))
    x = sample_particles(scene)
    poses = np.array([[*m.position, *m.rotation, m.gap] for m in scene.manipulators])
    mass = spread_mass(x + np.array([0.0, 0.3, 0.0]), 16, scene.particle_mass)
    scores = np.array([0.0, 0.1, 0.2, 0.3])
    return RecordedRollout("1", scene, mass, x + WAY[..., :3], poses + WAY, scores)


@pytest.fixture(scope="module")
def page(recording) -> str:
    return viewer.page(recording)


def things(page: str) -> dict[str, list[dict[str, Any]]]:
    """Objects of a page by group."""
    (packed,) = re.findall("var data = '([A-Za-z0-9+/=]*)';", page)
    found: dict[str, list[dict[str, Any]]] = {}
    for thing in msgpack.unpackb(zlib.decompress(base64.b64decode(packed)))["objects"]:
        found.setdefault(thing["group"], []).append(thing)
    return found


def frames(series: dict[str, Any]) -> dict[int, np.ndarray]:
    return {int(step): np.frombuffer(packed["data"], packed["dtype"]) for step, packed in series.items()}


def content(page: str) -> dict[str, Any]:
    return json.loads(re.search(r"const rollout = (.*);", page)[1])


def test_the_page_holds_particles_and_manipulators_of_every_frame(recording, page):
    (rope,) = things(page)["plasticine"]
    shown = frames(rope["positions"])
    assert list(shown) == [0, 1, 2, 3]
    for step, x in shown.items():
        assert x.reshape(-1, 3) == pytest.approx(recording.x[step], abs=0.51 / 2**16)
    tools = enumerate(recording.scene.manipulators)
    parts = [(k, side) for k, m in tools for _, side in shapes.manipulator_parts(m)]
    assert len(parts) == 3
    for thing, (number, side) in zip(things(page)["manipulators"], parts, strict=True):
        for step, matrix in frames(thing["model_matrix"]).items():
            expected = shapes.pose_matrix(recording.poses[step, number], side)
            assert matrix.reshape(4, 4) == pytest.approx(expected, abs=1e-6)


def test_the_page_holds_the_target_as_a_ghost_and_the_scores(recording, page):
    (ghost,) = things(page)["target"]
    assert 0.1 < ghost["opacity"] < 0.5
    points = np.frombuffer(ghost["vertices"]["data"], np.float32).reshape(-1, 3)
    nodes = np.argwhere(recording.target_mass > recording.target_mass.max() / 2) * recording.scene.dx
    assert points.mean(axis=0) == pytest.approx(nodes.mean(axis=0), abs=0.05)
    assert content(page)["scores"] == pytest.approx(recording.scores, abs=5e-4)
    assert content(page)["steps"] == 3

    without = viewer.page(dataclasses.replace(recording, target_mass=None, scores=None))
    assert things(without).keys() == {"plasticine", "manipulators", "floor"}
    assert content(without)["scores"] is None and 'data-group="target"' not in without


def test_surfaces_stand_for_particles_and_are_bounded(recording, monkeypatch):
    monkeypatch.setattr(viewer, "_VERTICES", 400)
    (rope,) = things(surfaces := viewer.page(recording, surface=True))["plasticine"]
    assert content(surfaces)["interpolate"] is False
    for step, points in frames(rope["vertices"]).items():
        points = points.reshape(-1, 3)
        assert 40 < len(points) <= 110 and frames(rope["indices"])[step].max() == len(points) - 1
        assert points.mean(axis=0) == pytest.approx(recording.x[step].mean(axis=0), abs=0.02)


def test_the_page_is_reproducible_and_asks_for_nothing(recording, page):
    assert viewer.page(recording) == page and not re.search(r"""(src|href)\s*=\s*["']""", page)
    assert "Permission is hereby granted" in page and "Three.js Authors" in page
    scene = dataclasses.replace(recording.scene, name="</title><b>")
    strange = viewer.page(dataclasses.replace(recording, scene=scene))
    assert "</title><b>" not in strange and "&lt;/title&gt;&lt;b&gt;, variant 1" in strange


def test_results_are_shown_beside_their_files_and_runs_of_archives_here(capsys, replayed, page):
    cfg = load_config(["task=Rope", "variant=2", *COARSE])
    numbers = {"status": "finished", "best_actions": ACTIONS}
    path = cfg.path
    path.parent.mkdir(parents=True)
    results.write(results.RunResult(results.config_dict(cfg), cfg.hash, **numbers), path)
    folder = path.parents[2]
    results.pack(folder, Path("runs.plab.zip.xz"))
    for source, shown in (
        (path, path.with_suffix(".html")),
        (f"runs.plab.zip.xz/{path.relative_to(folder)}", Path(f"{path.stem}.html")),
    ):
        assert main([str(source)]) == 0
        assert capsys.readouterr() == (f"{shown}\n", "")
        assert shown.read_text(encoding="utf-8") == page
    for replay, given in replayed:
        assert np.array_equal(given, ACTIONS) and replay.variant == "2"


def test_the_gallery_has_a_page_of_every_task(monkeypatch, replayed, page, capsys):
    monkeypatch.setattr("plab.view.page.page", lambda *_, **__: page)
    assert main(["--gallery"]) == 0 and capsys.readouterr().out.endswith("gallery/index.html\n")
    index = Path("gallery/index.html").read_text(encoding="utf-8")
    names = [f"{task}-v1.html" for task in suite_tasks()]
    assert re.findall('href="([^"]*)"', index) == names and len(replayed) == 10
    assert all(Path("gallery", name).read_text(encoding="utf-8") == page for name in names)


def test_a_notebook_shows_actions_of_a_configuration_a_result_and_a_task(replayed, recording, page):
    cfg = load_config(["task=Rope", "variant=2", *COARSE])
    view = show(cfg, ACTIONS, height=300)
    assert (view.page, view.score) == (page, recording.score)
    (shown,) = re.findall('<iframe [^>]*height: 300px[^>]* srcdoc="([^"]*)"></iframe>', view._repr_html_())
    assert html.unescape(shown) == page and len(repr(view)) < 100
    found = results.RunResult(results.config_dict(cfg), cfg.hash, best_actions=ACTIONS)
    results.write(found, Path("seed0.h5"))
    show("seed0.h5")
    show(cfg)
    assert all(one.variant == "2" for one, _ in replayed)
    for (_, given), expected in zip(replayed, (ACTIONS, ACTIONS, known_actions(cfg)), strict=True):
        assert np.array_equal(given, expected)
    with pytest.raises(graphics.RenderError, match="own actions"):
        show("seed0.h5", ACTIONS)


def seen(browser) -> tuple[bool, bool]:
    """Return whether red plasticine and the blue target are visible."""
    canvas = browser.find_element("id", "canvasTarget").screenshot_as_png
    picture = np.asarray(Image.open(io.BytesIO(canvas)).convert("RGB"), int)
    redness = picture[..., 0] - picture[..., 2]
    return bool((redness > 60).any()), bool((redness < -25).any())


@pytest.mark.nightly
@browsing
@pytest.mark.parametrize("framed", [False, True], ids=["page", "notebook"])
def test_the_page_plays_in_a_browser(browser, page, tmp_path, framed):
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    wait = WebDriverWait(browser, 60, poll_frequency=0.05)
    text = f"<!DOCTYPE html><body>{Viewer(page, 0.3)._repr_html_()}</body>" if framed else page
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    browser.get((tmp_path / "page.html").as_uri())
    if framed:
        browser.switch_to.frame(browser.find_element("tag name", "iframe"))
    told = browser.find_element("id", "told")
    wait.until(lambda _: told.text == "step 0 of 3, score 0.00")
    wait.until(lambda _: seen(browser) == (True, True))
    for key, step in () if framed else ((Keys.ARROW_RIGHT, 1), (Keys.END, 3), (Keys.HOME, 0)):
        browser.find_element("tag name", "body").send_keys(key)
        wait.until(lambda _, step=step: told.text.startswith(f"step {step} of 3"))
    browser.find_element("id", "play").click()
    wait.until(lambda _: told.text == "step 3 of 3, score 0.30")
    faded = "arguments[0].value = 0; arguments[0].dispatchEvent(new Event('input'))"
    for group, left in (("target", (True, False)), ("plasticine", (False, False))):
        browser.execute_script(faded, browser.find_element("css selector", f"[data-group={group}]"))
        wait.until(lambda _, left=left: seen(browser) == left)
    browser.switch_to.default_content()
    if framed:
        return
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [one["params"]["request"]["url"] for one in sent if one["method"] == "Network.requestWillBeSent"]
    assert asked and {urllib.parse.urlsplit(url).scheme for url in asked} <= {"file", "data", "blob"}
