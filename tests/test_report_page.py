"""Results page: content, and behaviour in a real browser."""

from __future__ import annotations

import json
import re
import shlex
import urllib.parse
from pathlib import Path

import pytest

import synthetic
from browsing import browsing, press, until
from plab.cli.report import main
from plab.config import load_config
from plab.config.selection import select
from plab.render.graphics import missing_graphics
from plab.report.collect import NAMES, collect
from plab.report.methods import method
from plab.report.page import _command, best_runs
from plab.results import config_dict, load
from synthetic_runs import synthetic_run, template
from toy_runner import COARSE

drawing = pytest.mark.skipif(missing_graphics() is not None, reason=str(missing_graphics()))


def coarse_run(folder: Path, variant: str, name: str, seed: int, score: float) -> Path:
    """Write the file of a synthetic run whose actions can be replayed quickly."""
    config = template(name, [f"results_dir={folder}", "task=Rope", f"variant={variant}", *COARSE])
    config["seed"] = seed
    return synthetic.save(synthetic_run(config, rows=6, score=score))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of two methods on two variants, two seeds for one of them."""
    folder = tmp_path_factory.mktemp("results")
    for variant in "12":
        for number, seed in enumerate((2, 10)):
            coarse_run(folder, variant, "adam", seed, 0.5 + 0.1 * number + 0.05 * int(variant))
        coarse_run(folder, variant, "gd", 0, 0.9 if variant == "1" else 0.2)
    return folder


def write(results: Path, out: Path, *more: str) -> Path:
    assert main(["html", "task=Move,Rope", str(results), "--output", str(out), *more]) == 0
    return out / "index.html"


@pytest.fixture(scope="module")
def page(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(results, tmp_path_factory.mktemp("page"), "--no-pictures")


def content(page: Path) -> dict:
    found = re.search(r'<script id="content" type="application/json">(.*)</script>', page.read_text())
    return json.loads(found[1])


def test_page_has_runs_and_what_is_missing(results: Path, page: Path) -> None:
    text, shown = " ".join(page.read_text().split()), content(page)
    known = {one["name"]: one["cells"] for one in shown["configurations"]}
    assert set(known) == {f"{task}-v{variant}" for task in ("Rope", "Move") for variant in "12345"}
    adam = known["Rope-v1"]["adam"]
    assert adam["ours"]["mean"] == pytest.approx(0.6) and adam["ours"]["std"] == pytest.approx(0.05)
    assert (adam["ours"]["count"], adam["ours"]["expected"]) == (2, 4)
    assert adam["paper"]["mean"] == 0.66 and adam["difference"][0] == pytest.approx(0.6 - 0.66)
    assert known["Move-v1"]["adam"]["ours"]["mean"] is None
    assert known["Rope-v1"]["gd"]["difference"][1:] == [None, None]
    (line,) = shown["tasks"]
    assert line["task"] == "Rope" and line["cells"]["adam"]["ours"]["count"] == 4
    assert line["cells"]["adam"]["ours"]["mean"] == pytest.approx((0.55 + 0.65 + 0.6 + 0.7) / 4)
    assert line["cells"]["adam"]["ours"]["expected"] == 20
    (best,) = shown["gallery"]
    assert (best["name"], best["method"], best["seed"], best["score"]) == ("Rope-v1", "gd", "0", 0.9)
    best = best_runs(collect(results, select(["task=Rope"], NAMES)))
    assert [one.name for one in best] == ["Rope-v1", "Rope-v2"]
    assert [best[0].runs[name]["seed"] for name in ("adam", "gd")] == ["10", "0"]

    assert "plab report html" in text and collect(results, select(["task=Move,Rope"], NAMES)).digest in text
    assert all(name in text for name in load(results)["config_hash"]) and "6 of 80 runs, 1 of 2 tasks" in text
    places = {look["name"]: look["css"] for look in shown["methods"]}
    for name in ("sac", "adam", "gd"):
        assert f"--{places[name]}: {method(name).colour};" in text


def test_details_have_curves_runs_and_commands(page: Path) -> None:
    text = (page.parent / "data" / "Rope-v1.js").read_text()
    name, details = json.loads("[" + text.removeprefix("plab.receive(").removesuffix(");\n") + "]")
    assert name == "Rope-v1" and set(details) == {"adam", "gd"}
    x, mean, std = details["adam"]["curves"]["reward"]["episodes"]
    assert x[0] == 1 and x[-1] == 6 and len(mean) == len(std) == len(x)
    command = details["adam"]["runs"][1]["command"]
    assert command.startswith("plab run task=Rope variant=1 method=adam seed=10")
    assert "sim.particles_scale=0.03" in command and "sim.horizon=3" in command and "FOLDER" not in command
    own = synthetic.config(page.parent, task="Own")
    own["method"]["loss_weights"]["height"] = 2.0
    assert _command(own).endswith(" +method.loss_weights.height=2.0 --config-dir FOLDER")
    own["method"]["name"] = "mine"
    assert " method.lr=0.1 " in _command(own) and " method.loss_weights.height=2.0 " in _command(own)


REPEATED = (
    "method=ppo method.name=ppo_fast method.num_envs=4",
    "method=ppo variant=2 +task.randomize.bodies.ball.yaw=[0,1] +task.randomize.scenes=4",
    "method=mpc method@method.planner=gd method.planner.iterations=3 method.window=9",
)


@pytest.mark.parametrize("words", REPEATED)
def test_the_command_of_a_run_repeats_it(words: str) -> None:
    config = config_dict(load_config(["task=Move", *words.split()]))
    assert config_dict(load_config(shlex.split(_command(config))[2:])) == config


def test_text_of_a_result_cannot_become_a_part_of_the_page(tmp_path: Path) -> None:
    config = synthetic.config(tmp_path / "<b>results")
    config["method"]["name"] = "<b>own"
    synthetic.save(synthetic_run(config, rows=2))
    page = write(tmp_path / "<b>results", tmp_path / "page", "--no-pictures")
    assert "<b>" not in page.read_text() and "&lt;b&gt;results" in page.read_text()
    assert "<b>own" in {look["name"] for look in content(page)["methods"]}


# -------------------------------------------------------------------------------------------- in the browser


def shown_names(browser) -> list[str]:
    return browser.execute_script(
        "return [...document.querySelectorAll('#configurations tbody tr')].map((row) => row.dataset.name)"
    )


@pytest.mark.nightly
@browsing
@drawing
def test_page_in_a_browser(browser, results: Path, tmp_path: Path) -> None:
    page = write(results, tmp_path / "page")
    browser.get(page.as_uri())
    browser.get_log("browser"), browser.get_log("performance")
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
    browser.get(page.as_uri() + "#Rope-v1")
    until(browser, "document.querySelectorAll('#configuration figure').length === 3")
    until(browser, "[...document.querySelectorAll('article img')].every((image) => image.complete)")
    script = "return [...document.querySelectorAll('article img')].map((image) => image.naturalWidth)"
    assert browser.execute_script(script) == [480, 480]
    press(browser, "article .play")
    until(browser, "[...document.querySelectorAll('article video')].every((film) => film.currentTime > 0)")
    until(browser, "document.querySelectorAll('article path.mean').length === 2")
    # Nothing went wrong, and nothing was asked of the network.
    assert browser.get_log("browser") == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [one["params"]["request"]["url"] for one in sent if one["method"] == "Network.requestWillBeSent"]
    assert asked and {urllib.parse.urlsplit(url).scheme for url in asked} == {"file"}
