"""The page of results: what it holds, and what it does in a real browser."""

from __future__ import annotations

import json
import re
import urllib.parse
from pathlib import Path

import pytest

import synthetic
from browsing import browsing, press, until
from plab.bench.results import synthetic_run, template
from plab.examples import example_archive
from plab.render.graphics import missing_graphics
from plab.report.__main__ import main
from plab.report.collect import NAMES, collect
from plab.report.media import best_runs, present
from plab.report.methods import method
from plab.results import load
from plab.selection import select

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")

drawing = pytest.mark.skipif(missing_graphics() is not None, reason=str(missing_graphics()))


def coarse_run(folder: Path, variant: str, name: str, seed: int, score: float) -> Path:
    """Write the file of a made-up run whose actions can be replayed in no time."""
    config = template(name, [f"results_dir={folder}", "task=Rope", f"variant={variant}", *COARSE])
    config["seed"] = seed
    return synthetic.save(synthetic_run(config, rows=6, score=score))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two variants, two seeds of one of them."""
    folder = tmp_path_factory.mktemp("results")
    for variant in "12":
        for seed in range(2):
            coarse_run(folder, variant, "adam", seed, 0.5 + 0.1 * seed + 0.05 * int(variant))
        coarse_run(folder, variant, "gd", 0, 0.9 if variant == "1" else 0.2)
    return folder


def write(results: Path, out: Path, *more: str) -> Path:
    assert main(["html", "task=Move,Rope", "--results", str(results), "--out", str(out), *more]) == 0
    return out / "index.html"


@pytest.fixture(scope="module")
def page(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(results, tmp_path_factory.mktemp("page"), "--no-pictures")


# ------------------------------------------------------------------------------------------------ without one


def content(page: Path) -> dict:
    found = re.search(r'<script id="content" type="application/json">(.*)</script>', page.read_text())
    return json.loads(found[1])


def test_overview_says_what_there_is_and_what_is_missing(page: Path) -> None:
    known = {one["name"]: one["cells"] for one in content(page)["configurations"]}
    assert set(known) == {f"{task}-v{variant}" for task in ("Rope", "Move") for variant in "12345"}
    adam = known["Rope-v1"]["adam"]
    assert adam["ours"]["mean"] == pytest.approx(0.6) and adam["ours"]["std"] == pytest.approx(0.05)
    assert (adam["ours"]["count"], adam["ours"]["expected"]) == (2, 3)
    assert adam["paper"]["mean"] == 0.66 and adam["difference"][0] == pytest.approx(0.6 - 0.66)
    assert known["Move-v1"]["adam"]["ours"]["mean"] is None
    assert known["Rope-v1"]["gd"]["difference"][1:] == [None, None]


def test_page_names_command_and_runs(results: Path, page: Path) -> None:
    text, table = page.read_text(), load(results)
    assert "python -m plab.report html" in text
    assert collect(results, select(["task=Move,Rope"], NAMES)).digest in text
    assert all(name in text for name in table["config_hash"])


def test_colours_are_those_of_the_figures(page: Path) -> None:
    text = page.read_text()
    for name in ("sac", "adam", "gd"):
        assert f"--{name}: {method(name).colour};" in text
    assert method("apg").on_dark != method("apg").colour


def test_details_have_curves_runs_and_commands(page: Path) -> None:
    text = (page.parent / "data" / "Rope-v1.js").read_text()
    name, details = json.loads("[" + text.removeprefix("plab.receive(").removesuffix(");\n") + "]")
    assert name == "Rope-v1" and set(details) == {"adam", "gd"}
    x, mean, std = details["adam"]["curves"]["reward"]["episodes"]
    assert x[0] == 1 and x[-1] == 6 and len(mean) == len(std) == len(x)
    command = details["adam"]["runs"][1]["command"]
    assert command.startswith("python -m plab.run task=Rope variant=1 method=adam seed=1")
    assert "sim.particles_scale=0.03" in command and "sim.horizon=3" in command


def test_best_runs_are_shown(results: Path) -> None:
    shown = best_runs(collect(results, select(["task=Rope"], NAMES)))
    assert [one.name for one in shown] == ["Rope-v1", "Rope-v2"]
    assert [shown[0].runs[name]["seed"] for name in ("adam", "gd")] == ["1", "0"]


def test_text_of_a_result_cannot_become_a_part_of_the_page(tmp_path: Path) -> None:
    config = synthetic.config(tmp_path / "<b>results")
    config["method"]["name"] = "<b>own"
    synthetic.save(synthetic_run(config, rows=2))
    page = write(tmp_path / "<b>results", tmp_path / "page", "--no-pictures")
    assert "<b>" not in page.read_text() and "&lt;b&gt;results" in page.read_text()
    assert "<b>own" in {look["name"] for look in content(page)["methods"]}


def test_the_example_gives_a_page(tmp_path: Path) -> None:
    assert main(["html", "--results", "example", "--out", str(tmp_path), "--no-pictures"]) == 0
    listed = content(tmp_path / "index.html")["configurations"]
    counted = [cell["ours"]["count"] for one in listed for cell in one["cells"].values()]
    assert sum(counted) == len(load(example_archive())) > 0


def test_nothing_finished_gives_one_line(tmp_path: Path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["html", "--results", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "no finished runs" in error and "example" in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


# --------------------------------------------------------------------------------------------- in the browser


def shown_names(browser) -> list[str]:
    return browser.execute_script(
        "return [...document.querySelectorAll('#configurations tbody tr')].map((row) => row.dataset.name)"
    )


@browsing
def test_table_sorts_and_searches(browser, page: Path) -> None:
    browser.get(page.as_uri())
    assert shown_names(browser) == ["Rope-v1", "Rope-v2"]
    press(browser, "#only")
    assert len(shown_names(browser)) == 10
    press(browser, "th[data-sort=gd] button")
    assert shown_names(browser)[:2] == ["Rope-v1", "Rope-v2"]
    press(browser, "th[data-sort=gd] button")
    # Those without a number stay below, whichever way is up.
    assert shown_names(browser)[:2] == ["Rope-v2", "Rope-v1"]
    press(browser, "#form button[value=paper]")
    assert "0.97" in browser.find_element("css selector", "tr[data-name=Move-v1]").text
    browser.find_element("id", "search").send_keys("move 3")
    assert shown_names(browser) == ["Move-v3"]
    browser.find_element("id", "search").send_keys("zzz")
    assert shown_names(browser) == [] and browser.find_element("id", "nothing").is_displayed()


@browsing
def test_configuration_without_pictures_shows_curves_and_runs(browser, page: Path) -> None:
    browser.get(page.as_uri())
    press(browser, "tr[data-name=Rope-v2]")
    until(browser, "document.querySelectorAll('.chart path.mean').length === 2")
    assert "No pictures" in browser.find_element("id", "configuration").text
    assert len(browser.find_elements("css selector", ".runs tbody tr")) == 3
    press(browser, ".choice button[value=score]")
    press(browser, ".legend button")
    until(browser, "document.querySelectorAll('.chart path.mean').length === 1")
    browser.back()
    assert browser.find_element("id", "overview").is_displayed()
    browser.get(page.as_uri() + "#Move-v1")
    until(browser, "document.querySelector('#configuration').innerText.includes('no finished runs')")


@browsing
@drawing
@pytest.mark.physics
def test_a_click_opens_a_configuration_and_its_pictures_load(browser, results: Path, tmp_path: Path) -> None:
    page = write(results, tmp_path / "page")
    browser.get(page.as_uri())
    browser.get_log("browser"), browser.get_log("performance")
    press(browser, "tr[data-name=Rope-v1]")
    until(browser, "document.querySelectorAll('#configuration figure').length === 4")
    until(browser, "[...document.images].every((image) => image.complete)")
    widths = browser.execute_script("return [...document.images].map((image) => image.naturalWidth)")
    assert widths == [480, 480]
    press(browser, ".play")
    until(browser, "[...document.querySelectorAll('video')].every((film) => film.currentTime > 0)")
    films = browser.execute_script(
        "return [...document.querySelectorAll('video')].map((film) => film.videoWidth)"
    )
    assert films == [480, 480]
    # Nothing went wrong, and nothing was asked of the network.
    assert browser.get_log("browser") == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [one["params"]["request"]["url"] for one in sent if one["method"] == "Network.requestWillBeSent"]
    assert asked and {urllib.parse.urlsplit(url).scheme for url in asked} == {"file"}


@drawing
@pytest.mark.physics
def test_pictures_are_drawn_once(results: Path, tmp_path: Path) -> None:
    out = write(results, tmp_path, "variant=2").parent
    (shown,) = best_runs(collect(results, select(["task=Rope", "variant=2"], NAMES)))
    made = present(shown, out)
    assert set(made) == {"start", "target", "adam", "adam film", "gd", "gd film"}
    before = {what: (out / path).stat().st_mtime_ns for what, path in made.items()}
    write(results, tmp_path, "variant=2")
    assert {what: (out / path).stat().st_mtime_ns for what, path in present(shown, out).items()} == before
    assert len(list((out / "media").iterdir())) == 1


@drawing
@pytest.mark.physics
def test_pictures_of_runs_that_are_no_longer_the_best_are_replaced(tmp_path: Path) -> None:
    coarse_run(tmp_path / "results", "1", "adam", 0, 0.3)
    out = write(tmp_path / "results", tmp_path / "page").parent
    (before,) = (out / "media").iterdir()
    coarse_run(tmp_path / "results", "1", "adam", 1, 0.4)
    write(tmp_path / "results", tmp_path / "page")
    (after,) = (out / "media").iterdir()
    assert after.name != before.name


def test_without_opengl_there_is_a_page_and_a_line(
    results: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr("plab.render.graphics.missing_graphics", lambda: "pictures need a painter")
    page = write(results, tmp_path)
    assert "without pictures: pictures need a painter" in capsys.readouterr().err
    assert page.is_file()
