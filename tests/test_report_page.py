"""The page of results: what it holds, and what it does in a real browser."""

from __future__ import annotations

import dataclasses
import json
import re
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import pytest

import synthetic
from browsing import browsing, press, until
from plab.bench.results import synthetic_run, template
from plab.cli.report import main
from plab.config.selection import select
from plab.examples import example_archive
from plab.locks import acquire
from plab.render import replays
from plab.render.graphics import missing_graphics
from plab.report.aggregate import interquartile_mean, shared_strata
from plab.report.collect import NAMES, collect
from plab.report.media import best_runs, present
from plab.report.methods import method
from plab.results import load

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
    places = {look["name"]: look["css"] for look in content(page)["methods"]}
    for name in ("sac", "adam", "gd"):
        assert f"--{places[name]}: {method(name).colour};" in text
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


def test_the_page_opens_with_a_sentence_on_what_it_shows(page: Path) -> None:
    text = " ".join(page.read_text().split())
    assert (
        "6 runs by Adam and GD on 2 configurations of Rope, scored from 0, where a task starts, to 1, "
        "its target." in text
    )
    assert "Incomplete are Adam with 4 and GD with 2 of 30 runs each." in text
    assert "6 of 60 runs, 1 of 2 tasks" in text


def test_a_line_per_task_and_its_best_run(page: Path) -> None:
    (line,) = content(page)["tasks"]
    assert line["task"] == "Rope" and line["cells"]["adam"]["ours"]["count"] == 4
    assert line["cells"]["adam"]["ours"]["mean"] == pytest.approx((0.55 + 0.65 + 0.6 + 0.7) / 4)
    assert line["cells"]["adam"]["ours"]["expected"] == 15
    (best,) = content(page)["gallery"]
    assert (best["name"], best["method"], best["seed"], best["score"]) == ("Rope-v1", "gd", "0", 0.9)


def test_aggregates_are_those_of_the_figures(results: Path, page: Path) -> None:
    shared = shared_strata(collect(results, select(["task=Move,Rope"], NAMES)))
    found = content(page)["aggregates"]
    value, low, high = found["mean"]["adam"]
    expected = interquartile_mean(shared.strata["adam"])
    assert (value, low, high) == pytest.approx((expected.value, expected.low, expected.high), abs=1e-4)
    assert found["better"]["gd"]["adam"][0] == 0.5
    x, (share, _, _) = found["profile"]["x"], found["profile"]["methods"]["gd"]
    assert dict(zip(x, share, strict=True)) == {at: (at < 0.2) / 2 + (at < 0.9) / 2 for at in x}
    assert found["notes"][-1] == "Configurations with a single run count as if others would give the same."


def test_a_method_with_few_configurations_does_not_take_the_others_down(tmp_path: Path) -> None:
    for variant in "123":
        for name in ("adam", "gd", "sac")[: 3 if variant == "1" else 2]:
            coarse_run(tmp_path / "results", variant, name, 0, 0.5)
    found = content(write(tmp_path / "results", tmp_path / "page", "--no-pictures"))["aggregates"]
    assert set(found["mean"]) == {"adam", "gd"}
    assert "Not shown, for they lack runs of these configurations: SAC (1 of 3)." in found["notes"]


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
    until(browser, "document.querySelectorAll('article path.mean').length === 2")
    assert "No pictures" in browser.find_element("id", "configuration").text
    assert len(browser.find_elements("css selector", ".runs tbody tr")) == 3
    press(browser, "article button[value=score]")
    press(browser, "article .legend button")
    until(browser, "document.querySelectorAll('article path.mean').length === 1")
    browser.back()
    assert browser.find_element("id", "overview").is_displayed()
    browser.get(page.as_uri() + "#Move-v1")
    until(browser, "document.querySelector('#configuration').innerText.includes('no finished runs')")


@browsing
def test_columns_without_a_number_are_hidden(browser, page: Path) -> None:
    def heads(table: str) -> list[str]:
        return [cell.text.split()[0] for cell in browser.find_elements("css selector", f"#{table} th")]

    browser.get(page.as_uri())
    assert heads("tasks") == ["task", "Adam", "GD"]
    assert heads("configurations") == ["task", "variant", "Adam", "GD", "runs"]
    press(browser, "#form button[value=paper]")
    assert heads("tasks") == ["task", "SAC", "TD3", "PPO", "Adam", "GD", "Adam-H"]
    press(browser, "#form button[value=difference]")
    assert heads("tasks") == ["task", "Adam", "GD"]
    # A minus is a minus, not a hyphen.
    assert "\u2212" in browser.find_element("id", "tasks").text
    assert not re.search(r"-\d", browser.find_element("id", "tasks").text)


@browsing
def test_all_configurations_together(browser, page: Path) -> None:
    browser.get(page.as_uri())
    assert [row.text.split()[0] for row in browser.find_elements("css selector", "#mean .dots")] == [
        "Adam",
        "GD",
    ]
    until(browser, "document.querySelectorAll('#profile path.mean').length === 2")
    cells = [cell.text for cell in browser.find_elements("css selector", "#better td.value")]
    assert [cell.split()[0] for cell in cells] == ["0.50", "0.50"]
    assert (
        "2 configurations of which every method shown has runs"
        in browser.find_element("id", "aggregates").text
    )


@browsing
def test_two_configurations_side_by_side(browser, page: Path) -> None:
    browser.get(page.as_uri() + "#Rope-v1")
    until(browser, "document.querySelectorAll('.plot').length === 2")
    browser.execute_script(
        "const choice = document.querySelector('#beside'); choice.value = 'Rope-v2';"
        "choice.dispatchEvent(new Event('change'))"
    )
    until(browser, "document.querySelectorAll('article .plot path.mean').length === 4")
    assert browser.current_url.endswith("#Rope-v1&Rope-v2") and "Rope-v1 and Rope-v2" in browser.title
    one, other = browser.find_elements("css selector", "article")
    assert one.rect["y"] == other.rect["y"] and one.rect["x"] < other.rect["x"]
    # One choice of what is drawn, for both.
    press(browser, "article button[value=score]")
    pressed = browser.find_elements("css selector", "article button[value=score][aria-pressed=true]")
    assert len(pressed) == 2


@browsing
def test_a_command_is_copied_without_a_clipboard_or_said_not_to_be(browser, page: Path) -> None:
    browser.get(page.as_uri() + "#Rope-v1")
    until(browser, "document.querySelectorAll('.copy').length === 3")
    # A page from a server without TLS has none.
    browser.execute_script(
        "Object.defineProperty(navigator, 'clipboard', {value: undefined, configurable: true});"
        "addEventListener('copy', () => { window.copied = document.activeElement.value; })"
    )
    press(browser, ".copy")
    until(browser, "document.querySelector('.copy').textContent === 'copied'")
    copied = browser.execute_script("return window.copied")
    assert copied.startswith("python -m plab.run task=Rope variant=1 method=adam seed=0")
    assert not browser.find_elements("css selector", "textarea")
    browser.execute_script("document.execCommand = () => false")
    press(browser, ".copy")
    until(browser, "document.querySelector('.copy').textContent.includes('cannot copy')")
    assert browser.find_element("css selector", ".runs .whole").text == copied


@pytest.fixture
def phone(browser) -> Iterator:
    """The browser, as narrow as a phone."""
    metrics = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    yield browser
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@browsing
def test_on_a_phone_nothing_sticks_out_and_the_legend_has_its_height(phone, page: Path) -> None:
    fits = "return document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    phone.get(page.as_uri())
    until(phone, "document.querySelectorAll('#profile path.mean').length === 2")
    assert phone.execute_script(fits)
    phone.get(page.as_uri() + "#Rope-v1")
    until(phone, "document.querySelectorAll('article .plot path.mean').length === 2")
    assert phone.execute_script(fits)
    heights = [
        line.rect["height"]
        for line in phone.find_elements("css selector", ".legend, .legend button, .legend svg")
    ]
    assert heights and max(heights) < 40
    assert phone.find_element("css selector", "article .plot svg").rect["height"] > 200


@browsing
def test_an_open_page_loads_itself_again_while_runs_are_under_way(browser, tmp_path: Path) -> None:
    results, out = tmp_path / "results", tmp_path / "page"
    coarse_run(results, "1", "adam", 0, 0.4)
    unfinished = template("adam", [f"results_dir={results}", "task=Rope", "seed=1", *COARSE])
    partial = synthetic.save(dataclasses.replace(synthetic_run(unfinished, rows=3), status="partial"))
    lock = acquire(partial)
    assert lock is not None
    page = write(results, out, "--no-pictures")
    assert content(page)["live"]
    browser.get(page.as_uri())
    browser.execute_script("document.body.dataset.mark = 'as it was'")
    browser.find_element("id", "search").send_keys("rope")
    coarse_run(results, "2", "adam", 0, 0.9)
    lock.release()
    write(results, out, "--no-pictures")
    # A script that waits would end with the page that it waits in.
    for _ in range(100):
        time.sleep(0.2)
        if browser.execute_script("return document.body.dataset.mark") is None:
            break
    until(browser, "document.querySelectorAll('#configurations tbody tr').length === 2")
    assert browser.execute_script("return document.body.dataset.mark") is None
    # Nothing is under way any more: it stays as it is.
    assert not content(page)["live"]


@browsing
@drawing
def test_a_click_opens_a_configuration_and_its_pictures_load(browser, results: Path, tmp_path: Path) -> None:
    page = write(results, tmp_path / "page", "--every-run")
    browser.get(page.as_uri())
    browser.get_log("browser"), browser.get_log("performance")
    # The best run of the task, in the gallery.
    assert "Rope" in browser.find_element("css selector", "#gallery figcaption").text
    assert browser.find_elements("css selector", "#gallery video")
    press(browser, "tr[data-name=Rope-v1]")
    until(browser, "document.querySelectorAll('#configuration figure').length === 4")
    until(browser, "[...document.querySelectorAll('article img')].every((image) => image.complete)")
    script = "return [...document.querySelectorAll('article img')].map((image) => image.naturalWidth)"
    assert browser.execute_script(script) == [480, 480]
    press(browser, "article .play")
    until(browser, "[...document.querySelectorAll('article video')].every((film) => film.currentTime > 0)")
    films = browser.execute_script(
        "return [...document.querySelectorAll('article video')].map((film) => film.videoWidth)"
    )
    assert films == [480, 480]
    # Nothing went wrong, and nothing was asked of the network.
    assert browser.get_log("browser") == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [one["params"]["request"]["url"] for one in sent if one["method"] == "Network.requestWillBeSent"]
    assert asked and {urllib.parse.urlsplit(url).scheme for url in asked} == {"file"}


@drawing
def test_pictures_are_drawn_once(results: Path, tmp_path: Path) -> None:
    out = write(results, tmp_path, "variant=2").parent
    (shown,) = best_runs(collect(results, select(["task=Rope", "variant=2"], NAMES)))
    made = present(shown, out)
    assert set(made) == {"start", "target", "adam", "adam film"}
    before = {what: (out / path).stat().st_mtime_ns for what, path in made.items()}
    write(results, tmp_path, "variant=2")
    assert {what: (out / path).stat().st_mtime_ns for what, path in present(shown, out).items()} == before
    assert len(list((out / "media").iterdir())) == 1


@drawing
def test_pictures_of_runs_that_are_no_longer_the_best_are_replaced(tmp_path: Path) -> None:
    coarse_run(tmp_path / "results", "1", "adam", 0, 0.3)
    out = write(tmp_path / "results", tmp_path / "page").parent
    (before,) = (out / "media").iterdir()
    coarse_run(tmp_path / "results", "1", "adam", 1, 0.4)
    write(tmp_path / "results", tmp_path / "page")
    (after,) = (out / "media").iterdir()
    assert after.name != before.name


@drawing
def test_a_build_that_is_stopped_has_its_pictures(results: Path, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "media" / ".unfinished-killed").mkdir(parents=True)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "Rope-v1.js.1.tmp").write_text("half")
    drawn: list[str] = []

    def stopped(recordings, folder, size, filmed):
        if drawn:
            raise KeyboardInterrupt
        drawn.append(folder.name)
        (folder / "start.webp").write_bytes(b"a picture")

    monkeypatch.setattr("plab.render.replays.save_set", stopped)
    code = main(["html", "task=Rope", "--results", str(results), "--out", str(tmp_path)])
    assert code == 130
    listed = content(tmp_path / "index.html")["configurations"]
    assert [one["name"] for one in listed if one["pictures"]] == ["Rope-v1"]
    assert not content(tmp_path / "index.html")["live"]
    # The one with the film of the task came first, and nothing is left of the other.
    (folder,) = (tmp_path / "media").iterdir()
    assert folder.name.startswith("Rope-v1-")
    assert not list(tmp_path.rglob("*.tmp"))


@drawing
def test_the_page_is_written_again_with_each_configuration(
    results: Path, tmp_path: Path, monkeypatch
) -> None:
    seen: list[tuple[int, bool]] = []
    save = replays.save_set

    def looking(*arguments):
        page = content(tmp_path / "index.html")
        seen.append((sum(bool(one["pictures"]) for one in page["configurations"]), page["live"]))
        save(*arguments)

    monkeypatch.setattr(replays, "save_set", looking)
    page = write(results, tmp_path)
    assert seen == [(0, True), (1, True)]
    assert sum(bool(one["pictures"]) for one in content(page)["configurations"]) == 2
    assert not content(page)["live"]


def test_following_ends_when_no_run_is_under_way(tmp_path: Path, monkeypatch, capsys) -> None:
    results, out = tmp_path / "results", tmp_path / "page"
    unfinished = template("adam", [f"results_dir={results}", "task=Rope", "seed=1", *COARSE])
    partial = synthetic.save(dataclasses.replace(synthetic_run(unfinished, rows=3), status="partial"))
    lock = acquire(partial)
    seen: list[bool] = []

    def later(seconds: float) -> None:
        seen.append((out / "index.html").exists())
        if len(seen) == 1:
            coarse_run(results, "1", "adam", 0, 0.4)
        elif len(seen) == 2:
            lock.release()

    monkeypatch.setattr("time.sleep", later)
    assert main(["html", "--follow", "--no-pictures", "--results", str(results), "--out", str(out)]) == 0
    assert seen == [False, True, True]
    assert not content(out / "index.html")["live"]
    assert capsys.readouterr().out.count("index.html of 1 out of") == 2


def test_without_opengl_there_is_a_page_and_a_line(
    results: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr("plab.render.graphics.missing_graphics", lambda: "pictures need a painter")
    page = write(results, tmp_path)
    assert "without pictures: pictures need a painter" in capsys.readouterr().err
    assert page.is_file()
