"""The viewer: what its page holds, what it does in a real browser, the command line."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import json
import re
import shutil
import time
import urllib.parse
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from plab import results
from plab.cli.view import main
from plab.config import build_scene, load_config
from plab.demonstrations import known_actions
from plab.problem import Problem
from plab.render import graphics
from plab.render.recording import RecordedRollout, record, record_with_motion
from plab.render.shapes import manipulator_parts, pose_matrix
from plab.sim import Simulator
from plab.view import Viewer, show

msgpack = pytest.importorskip("msgpack")
viewer = pytest.importorskip("plab.view.page")


COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")
ACTIONS = np.full((3, 6), 0.5)

BROWSER, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))
browsing = pytest.mark.skipif(
    not (BROWSER and DRIVER), reason="chromium and chromedriver are not installed: make browser-packages"
)


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def recording() -> RecordedRollout:
    return record(load_config(["task=Rope", *COARSE]), ACTIONS)


@pytest.fixture(scope="module")
def page(recording) -> str:
    return viewer.page(recording)


def things(page: str) -> dict[str, list[dict[str, Any]]]:
    """What a page shows, by group."""
    (packed,) = re.findall("var data = '([A-Za-z0-9+/=]*)';", page)
    found: dict[str, list[dict[str, Any]]] = {}
    for thing in msgpack.unpackb(zlib.decompress(base64.b64decode(packed)))["objects"]:
        found.setdefault(thing["group"], []).append(thing)
    return found


def frames(series: dict[str, Any]) -> dict[int, np.ndarray]:
    return {int(step): np.frombuffer(packed["data"], packed["dtype"]) for step, packed in series.items()}


def content(page: str) -> dict[str, Any]:
    return json.loads(re.search(r"const rollout = (.*);", page)[1])


# ------------------------------------------------------------------------------------------------- the page


def test_the_page_holds_every_particle_of_every_frame(recording, page):
    (rope,) = things(page)["plasticine"]
    shown = frames(rope["positions"])
    assert list(shown) == [0, 1, 2, 3]
    for step, x in shown.items():
        assert x.reshape(-1, 3) == pytest.approx(recording.x[step], abs=0.51 / 2**16)


def test_the_page_holds_the_manipulators_at_their_poses(recording, page):
    shown = things(page)["manipulators"]
    parts = [
        (number, part)
        for number, manipulator in enumerate(recording.scene.manipulators)
        for part in manipulator_parts(manipulator)
    ]
    assert len(shown) == len(parts) == 3
    for thing, (number, part) in zip(shown, parts, strict=True):
        for step, matrix in frames(thing["model_matrix"]).items():
            expected = pose_matrix(recording.poses[step, number], part.side)
            assert matrix.reshape(4, 4) == pytest.approx(expected, abs=1e-6)


def test_the_page_holds_the_target_as_a_ghost_and_the_scores(recording, page):
    (ghost,) = things(page)["target"]
    assert 0.1 < ghost["opacity"] < 0.5
    points = np.frombuffer(ghost["vertices"]["data"], np.float32).reshape(-1, 3)
    nodes = np.argwhere(recording.target_mass > recording.target_mass.max() / 2) * recording.scene.dx
    assert points.mean(axis=0) == pytest.approx(nodes.mean(axis=0), abs=0.05)
    assert content(page)["scores"] == pytest.approx(recording.scores, abs=5e-4)
    assert content(page)["steps"] == 3


def test_without_a_target_there_is_neither_ghost_nor_score(recording):
    page = viewer.page(dataclasses.replace(recording, target_mass=None, scores=None))
    assert things(page).keys() == {"plasticine", "manipulators", "floor"}
    assert content(page)["scores"] is None
    assert 'data-group="target"' not in page


def test_the_same_rollout_gives_the_same_page_which_asks_for_nothing(recording, page):
    assert viewer.page(recording) == page
    assert not re.search(r"""(src|href)\s*=\s*["']""", page)
    assert "Permission is hereby granted" in page and "Three.js Authors" in page


def test_long_rollouts_have_sixty_frames_and_every_asks_for_others(recording):
    long = dataclasses.replace(
        recording,
        x=np.repeat(recording.x[:1], 151, axis=0),
        poses=np.repeat(recording.poses[:1], 151, axis=0),
        scores=np.zeros(151),
    )
    steps = [
        list(frames(things(viewer.page(long, every))["plasticine"][0]["positions"])) for every in (None, 100)
    ]
    assert steps == [[*range(0, 151, 3)], [0, 100, 150]]


def test_of_very_many_particles_some_are_shown(recording, monkeypatch):
    monkeypatch.setattr(viewer, "_POSITIONS", 2 * recording.scene.particle_count)
    (rope,) = things(viewer.page(recording))["plasticine"]
    assert frames(rope["positions"])[3].reshape(-1, 3) == pytest.approx(recording.x[3, ::2], abs=0.51 / 2**16)


def test_a_name_cannot_leave_its_place(recording):
    page = viewer.page(dataclasses.replace(recording, task="</title><b>"))
    assert "</title><b>" not in page and "&lt;/title&gt;&lt;b&gt;, variant 1" in page


# ---------------------------------------------------------------------------------------------- target files


def test_a_target_whose_file_is_elsewhere_is_left_out_and_it_says_so(capsys):
    cfg = load_config(["task=Rope", *COARSE])
    cfg = dataclasses.replace(cfg, targets=dataclasses.replace(cfg.targets, source="elsewhere"))
    found = record_with_motion(cfg, ACTIONS)
    assert found.target_mass is None and found.scores is None and np.isnan(found.score)
    assert found.x.shape == (4, found.scene.particle_count, 3) and found.F.shape == (*found.x.shape, 3)
    line = "plab: without target and scores: targets.source: there is no folder elsewhere\n"
    assert capsys.readouterr().err == line


def test_a_target_whose_file_is_at_hand_is_shown_and_it_says_so(capsys):
    cfg = load_config(["task=Rope", *COARSE])
    mass = Problem([cfg]).target_mass[0]
    Path("files").mkdir()
    np.save("files/Rope3D-v1.npy", mass)
    cfg = dataclasses.replace(cfg, targets=dataclasses.replace(cfg.targets, source="files"))
    found = record_with_motion(cfg, ACTIONS)
    assert np.array_equal(found.target_mass, mass)
    assert (
        capsys.readouterr().err == "plab: with the target of your file in files: mind whom you give it to\n"
    )


# --------------------------------------------------------------------------------------------- command line


@pytest.fixture
def simulated(monkeypatch, recording) -> list:
    """Take the recording instead of simulating; return what was to be simulated."""
    asked = []

    def stand_in(cfg, actions):
        asked.append((cfg, actions))
        return recording

    monkeypatch.setattr("plab.render.recording.record_with_motion", stand_in)
    return asked


def test_a_result_is_shown_beside_its_file(capsys, simulated, page):
    cfg = load_config(["task=Rope", "variant=2", *COARSE])
    found = results.RunResult(results.config_dict(cfg), results.config_hash(cfg), best_actions=ACTIONS)
    Path("mine").mkdir()
    results.write(found, Path("mine/seed0.h5"))
    assert main(["mine/seed0.h5"]) == 0
    assert capsys.readouterr() == ("mine/seed0.html\n", "")
    assert Path("mine/seed0.html").read_text(encoding="utf-8") == page
    ((replay, given),) = simulated
    assert np.array_equal(given, ACTIONS) and replay.variant == "2"


def test_a_run_of_an_archive_is_shown_here(capsys, simulated):
    cfg = load_config(["task=Rope", *COARSE])
    found = results.RunResult(
        results.config_dict(cfg), results.config_hash(cfg), status="finished", best_actions=ACTIONS
    )
    path = results.result_path(cfg)
    path.parent.mkdir(parents=True)
    results.write(found, path)
    results.pack(path.parents[2], Path("runs.plab.zip.xz"))
    assert main([f"runs.plab.zip.xz/{path.relative_to(path.parents[2])}"]) == 0
    assert capsys.readouterr().out == f"{path.stem}.html\n"


@pytest.mark.parametrize(("package", "name"), [("k3d", "K3D-jupyter"), ("pyvista", "PyVista")])
def test_a_missing_package_is_named(monkeypatch, capsys, package, name):
    monkeypatch.setattr(graphics, "find_spec", lambda wanted: None if wanted == package else object())
    assert main(["task=Rope"]) == 2
    line = f"plab: the viewer needs {name}, which is not installed: pip install 'plab[view]'\n"
    assert capsys.readouterr() == ("", line)


def test_another_suffix_is_refused(capsys):
    assert main(["task=Rope", "--output", "rope.gif"]) == 2
    assert capsys.readouterr() == ("", "plab: cannot write rope.gif: its suffix must be .html\n")


# ------------------------------------------------------------------------------------------- in the browser


@pytest.fixture(scope="module")
def browser() -> Iterator:
    selenium = pytest.importorskip("selenium.webdriver")
    options = selenium.ChromeOptions()
    options.binary_location = BROWSER
    # WebGL without a graphics card.
    software = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for argument in ("--headless=new", "--no-sandbox", "--window-size=1000,800", *software):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "SEVERE", "performance": "ALL"})
    driver = selenium.Chrome(options, selenium.ChromeService(DRIVER))
    driver.set_script_timeout(60)
    yield driver
    driver.quit()


def until(condition: Callable[[], bool]) -> None:
    """Wait until something is true, for a minute."""
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def colors(browser) -> set[tuple[int, ...]]:
    """Colours of what is seen of the scene."""
    canvas = browser.find_element("id", "canvasTarget").screenshot_as_png
    picture = Image.open(io.BytesIO(canvas)).convert("RGB")
    return {color for _, color in picture.getcolors(picture.width * picture.height)}


def is_blue(color: tuple[int, ...]) -> bool:
    return color[2] > color[0] + 25


def is_red(color: tuple[int, ...]) -> bool:
    return color[0] > color[2] + 60


@browsing
def test_the_page_plays_in_a_browser(browser, page, tmp_path):
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    browser.get((tmp_path / "page.html").as_uri())
    told = browser.find_element("id", "told")
    until(lambda: told.text == "step 0 of 3, score 0.00")
    until(lambda: any(map(is_red, colors(browser))) and any(map(is_blue, colors(browser))))

    browser.find_element("id", "play").click()
    until(lambda: told.text.startswith("step 3 of 3, score"))
    until(lambda: browser.find_element("id", "play").text == "Play")

    faded = "arguments[0].value = 0; arguments[0].dispatchEvent(new Event('input'))"
    for group, vanished in (("target", is_blue), ("plasticine", is_red)):
        slider = browser.find_element("css selector", f"[data-group={group}]")
        browser.execute_script(faded, slider)
        until(lambda vanished=vanished: not any(map(vanished, colors(browser))))

    assert browser.get_log("browser") == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [one["params"]["request"]["url"] for one in sent if one["method"] == "Network.requestWillBeSent"]
    assert asked and {urllib.parse.urlsplit(url).scheme for url in asked} <= {"file", "data", "blob"}


# ------------------------------------------------------------------------------------------ in a notebook


def test_a_notebook_shows_the_page_in_a_frame(recording, page, monkeypatch):
    monkeypatch.setattr("plab.render.recording.record_with_motion", lambda cfg, actions: recording)
    view = show(load_config(["task=Rope", *COARSE]), ACTIONS, height=300)
    assert (view.page, view.score) == (page, recording.score)
    (shown,) = re.findall('<iframe [^>]*height: 300px[^>]* srcdoc="([^"]*)"></iframe>', view._repr_html_())
    assert html.unescape(shown) == page
    assert len(repr(view)) < 100


def test_actions_of_a_result_and_of_a_task_are_shown(simulated):
    cfg = load_config(["task=Rope", "variant=2", *COARSE])
    found = results.RunResult(results.config_dict(cfg), results.config_hash(cfg), best_actions=ACTIONS)
    results.write(found, Path("seed0.h5"))
    show("seed0.h5")
    show(cfg)
    (replay, played), (known, demonstrated) = simulated
    assert replay.variant == known.variant == "2"
    assert np.array_equal(played, ACTIONS)
    assert np.array_equal(demonstrated, known_actions(cfg))
    with pytest.raises(graphics.RenderError, match="a result file has its own actions"):
        show("seed0.h5", ACTIONS)


def test_simulators_stay_usable_beside_the_viewer(simulated, monkeypatch):
    cfg = load_config(["task=Rope", *COARSE])
    assert cfg.sim.precision == "float32"
    # Whatever was started by the other tests: nobody uses it but this.
    simulator = Simulator([build_scene(cfg)], precision="float64")
    show(cfg, ACTIONS)
    assert simulated[0][0].sim.precision == "float64" and cfg.sim.precision == "float32"
    simulator.reset()
    assert simulator.state().x.dtype == np.float64
    # Without that it would say so, also where memory that is gone would end the process.
    monkeypatch.setattr("plab.sim.forward.is_current", lambda runtime: False)
    mass = np.zeros((1, 16, 16, 16))
    for change in (
        lambda: simulator.set_material(yield_stress=50.0),
        lambda: simulator.set_target(mass, mass),
    ):
        with pytest.raises(RuntimeError, match="this simulator's memory is gone"):
            change()


@browsing
def test_the_viewer_plays_in_a_notebooks_frame(browser, page, recording, tmp_path):
    frame = Viewer(page, recording.score)._repr_html_()
    (tmp_path / "notebook.html").write_text(f"<!DOCTYPE html><body>{frame}</body>", encoding="utf-8")
    browser.get((tmp_path / "notebook.html").as_uri())
    browser.switch_to.frame(browser.find_element("tag name", "iframe"))
    told = browser.find_element("id", "told")
    until(lambda: told.text == "step 0 of 3, score 0.00")
    until(lambda: any(map(is_red, colors(browser))))
    browser.find_element("id", "play").click()
    until(lambda: told.text.startswith("step 3 of 3, score"))
    browser.switch_to.default_content()
