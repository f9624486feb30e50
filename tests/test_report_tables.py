"""The paper's tables from results: numbers, intervals, what is missing, files."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import synthetic
from plab.cli.report import main
from plab.config import load_config
from plab.config.selection import SelectionError, select
from plab.examples import EXAMPLES, example_archive, resolve
from plab.report.agreement import agreement
from plab.report.collect import NAMES, MixedRunsError, Setting, changed_settings, collect
from plab.report.hyperparameters import hyperparameters
from plab.report.methods import method as look
from plab.report.reference import paper_table
from plab.report.statistics import Summary, stratified_difference, summarise
from plab.report.table import NOTHING, Table, aligned, number, write_table
from plab.report.tables import iou_per_configuration, iou_per_task, solvability
from plab.report.times import timing
from plab.report.writing import write_tables
from plab.results import check, config_dict, load, pack

GOLDEN = Path(__file__).parent / "golden"
PAGE = Path(__file__).parents[1] / "docs" / "methods.md"
README = PAGE.parents[1] / "README.md"


def score(task: str, variant: str, method: str, seed: int) -> float:
    """Return a score that can be computed by head: 0.1 per variant, 0.01 per seed, a little per method."""
    lead = {"adam": 0.05, "gd": 0.0, "adam_h": 0.02, "ppo": 0.3}[method]
    return 0.1 * int(variant) + 0.01 * seed + lead


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All gradient runs of Rope but one, two runs of PPO, one unfinished, one of another variant."""
    results = tmp_path_factory.mktemp("results")
    for method in ("adam", "gd", "adam_h"):
        for variant in "12345":
            for seed in range(3):
                if (method, variant, seed) != ("gd", "5", 2):
                    which = {"task": "Rope", "variant": variant, "method": method, "seed": seed}
                    synthetic.save(synthetic.run(results, score=score(**which), **which))
    for variant in "12":
        which = {"task": "Move", "variant": variant, "method": "ppo", "seed": 0}
        synthetic.save(synthetic.run(results, score=score(**which), **which))
    begun = synthetic.run(results, variant="5", method="gd", seed=2)
    begun.status, begun.evaluation = "stopped", {}
    synthetic.save(begun)
    synthetic.save(synthetic.run(results, variant="random3"))
    return results


def gather(folder: Path, *words: str):
    return collect(folder, select(words, NAMES))


def by_form(tables: list[Table]) -> dict[str, Table]:
    return {table.form: table for table in tables}


# ------------------------------------------------------------------------------------------------ the paper's


def test_the_papers_two_tables_agree_with_population_standard_deviations() -> None:
    tasks = paper_table("iou_per_task").set_index(["task", "method"])
    groups = paper_table("iou_per_configuration").groupby(["task", "method"])
    mean = groups["iou_mean"].mean()
    std = np.sqrt(groups["iou_mean"].var(ddof=0) + groups["iou_std"].agg(lambda s: (s**2).mean()))
    assert len(mean) == len(tasks) == 60
    # Both are rounded to two decimals.
    assert np.abs(mean - tasks["iou_mean"]).max() < 0.0101
    assert np.abs(std - tasks["iou_std"]).max() < 0.0101


def test_paper_form_has_the_papers_numbers_and_bold(folder: Path) -> None:
    table = by_form(iou_per_task(gather(folder)))["paper"]
    assert table.cells.shape == (10, 7)
    rope = table.cells.set_index("task").loc["Rope"]
    assert rope["Adam"] == "0.59 ± 0.13" and rope["PPO"] == "0.38 ± 0.19"
    bold = pd.DataFrame(table.bold, index=table.cells["task"], columns=table.cells.columns)
    assert bold.loc["Move"].to_list() == [False, False, False, True, True, False, False]
    assert bold.loc["Torus", ["SAC", "GD"]].all() and bold.loc["Torus"].sum() == 2
    # Nobody is best where all have nothing: then all are.
    assert bold.loc["Assembly", "PPO"] and not bold.loc["Assembly", "SAC"]


# ----------------------------------------------------------------------------------------------------- ours


def test_means_and_spreads_over_variants_and_seeds(folder: Path) -> None:
    table = by_form(iou_per_task(gather(folder)))["ours"]
    expected = np.array([score("Rope", v, "adam", s) for v in "12345" for s in range(3)])
    row = table.data.set_index(["task", "method"]).loc[("Rope", "adam")]
    assert row["mean"] == pytest.approx(expected.mean()) and row["std"] == pytest.approx(expected.std())
    assert (row["runs"], row["expected"]) == (15, 15)
    cells = table.cells.set_index("task")
    assert cells.loc["Rope", "Adam"] == f"{expected.mean():.2f} ± {expected.std():.2f}"


def test_incomplete_cells_say_how_many_runs_they_hold_and_nobody_is_bold(folder: Path) -> None:
    table = by_form(iou_per_task(gather(folder)))["ours"]
    cells = table.cells.set_index("task")
    assert cells.loc["Rope", "GD"].endswith("(14/15)")
    assert cells.loc["Move", "PPO"] == "0.45 ± 0.05 (2/15)"
    assert cells.loc["Move", "SAC"] == "0/15"
    assert not table.bold.any()
    complete = by_form(iou_per_task(gather(folder, "variant=1,2,3,4")))["ours"]
    bold = pd.DataFrame(complete.bold, index=complete.cells["task"], columns=complete.cells.columns)
    assert bold.loc["Rope"].to_list() == [False, False, False, False, True, False, False]


def test_configurations_have_a_row_each(folder: Path) -> None:
    tables = by_form(iou_per_configuration(gather(folder)))
    assert tables["ours"].cells.shape == (50, 8) and len(tables["comparison"].cells) == 300
    row = tables["ours"].data.set_index(["task", "variant", "method"]).loc[("Rope", "3", "adam_h")]
    assert row["mean"] == pytest.approx(0.33) and row["runs"] == 3
    single = tables["ours"].cells.set_index(["task", "variant"]).loc[("Move", "1"), "PPO"]
    assert single == "0.40 (1/3)"


def test_unfinished_and_other_runs_are_counted_not_used(folder: Path) -> None:
    runs = gather(folder)
    assert (runs.unfinished, runs.others) == (1, 1)
    assert len(runs.table) == 3 * 15 - 1 + 2


def test_archive_gives_the_same_digest_and_tables(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    pack(folder, archive)
    loose, packed = gather(folder), gather(archive)
    assert loose.digest == packed.digest
    for one, other in zip(iou_per_task(loose), iou_per_task(packed), strict=True):
        pd.testing.assert_frame_equal(one.data, other.data)
    assert gather(folder, "task=Move").digest != loose.digest


# ------------------------------------------------------------------------------------------------- comparison


def test_difference_has_welchs_interval_in_a_single_stratum() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.5, 0.1, 7), rng.normal(0.2, 0.3, 4)
    found = stratified_difference([summarise(a)], [summarise(b)])
    expected = stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    assert found.value == pytest.approx(a.mean() - b.mean())
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


def test_strata_take_the_variance_between_variants_out() -> None:
    ours = [Summary(mean, 0.01, 3) for mean in (0.1, 0.5, 0.9)]
    theirs = [Summary(mean - 0.05, 0.01, 3) for mean in (0.1, 0.5, 0.9)]
    found = stratified_difference(ours, theirs)
    assert found.value == pytest.approx(0.05) and 0.02 < found.low < found.high < 0.08


def test_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(2000):
        ours = [summarise(rng.normal(mean + 0.1, 0.1, 3)) for mean in (0.0, 0.5, 2.0, 3.0, 4.0)]
        theirs = [summarise(rng.normal(mean, 0.2, 3)) for mean in (0.0, 0.5, 2.0, 3.0, 4.0)]
        found = stratified_difference(ours, theirs)
        hits += found.low <= 0.1 <= found.high
    assert 0.93 < hits / 2000 < 0.975


def test_too_few_runs_give_no_interval() -> None:
    found = stratified_difference([Summary(0.5, 0.0, 1), Summary(0.2, 0.1, 3)], [Summary(0.4, 0.1, 3)] * 2)
    assert found.value == pytest.approx(-0.05) and np.isnan(found.low)
    nothing = stratified_difference([summarise([])], [Summary(0.4, 0.1, 3)])
    assert np.isnan(nothing.value)


def test_difference_is_over_the_variants_that_both_have(folder: Path) -> None:
    data = by_form(iou_per_task(gather(folder)))["comparison"].data.set_index(["task", "method"])
    # The paper's PPO on Move: 0.72 and 0.60 in variants 1 and 2.
    row = data.loc[("Move", "ppo")]
    assert row["difference"] == pytest.approx((0.4 - 0.72 + 0.5 - 0.60) / 2)
    assert np.isnan(row["low"])
    row = data.loc[("Rope", "adam")]
    assert row["low"] < row["difference"] < row["high"]
    assert row["difference"] == pytest.approx(row["mean"] - np.mean([0.66, 0.71, 0.52, 0.37, 0.70]))


# --------------------------------------------------------------------------------------------------- settings


def test_mixed_settings_are_refused_with_advice(folder: Path, tmp_path: Path) -> None:
    for seed, scale in enumerate((0.5, 0.25)):
        other = synthetic.config(tmp_path, seed=seed)
        other["sim"]["particles_scale"] = scale
        synthetic.save(synthetic.synthetic_run(other, rows=synthetic.ROWS))
    with pytest.raises(MixedRunsError, match=r"Rope adam differ in sim\.particles_scale.*choose one"):
        gather(tmp_path)
    runs = gather(tmp_path, "sim.particles_scale=0.5")
    assert len(runs.table) == 1
    assert list(map(str, runs.unusual)) == [
        f"method.iterations = {synthetic.ROWS}",
        "sim.particles_scale = 0.5",
    ]
    note = by_form(iou_per_task(runs))["ours"].notes[-1]
    assert "sim.particles_scale = 0.5" in note


def test_runs_that_try_something_do_not_disturb_the_others(tmp_path: Path) -> None:
    for seed, stress in enumerate((200.0, 50.0, 10.0)):
        other = synthetic.config(tmp_path, seed=seed)
        other["task"]["yield_stress"], other["method"]["iterations"] = stress, 200
        synthetic.save(synthetic.synthetic_run(other, rows=2))
    runs = gather(tmp_path)
    assert (len(runs.table), runs.set_aside, runs.unusual) == (1, 2, [])
    assert len(gather(tmp_path, "task.yield_stress=10").table) == 1


@pytest.mark.parametrize("key", ["seed_particles", "observe_particles"])
def test_settings_of_no_section_are_told_apart(tmp_path: Path, key: str) -> None:
    # In files of their own and in an archive, whose runs share their sections.
    for seed in range(2):
        other = synthetic.config(tmp_path / "results", seed=seed)
        other[key] += seed
        other["method"]["iterations"] = 200
        synthetic.save(synthetic.synthetic_run(other, rows=2))
    archive = tmp_path / "both.plab.zip.xz"
    pack(tmp_path / "results", archive)
    for source in (tmp_path / "results", archive):
        runs = gather(source)
        assert (list(runs.table["seed"]), runs.set_aside, runs.unusual) == (["0"], 1, [])


def test_changed_task_is_noted_and_not_mixed(tmp_path: Path) -> None:
    for seed, stress in enumerate((50.0, 10.0)):
        other = synthetic.config(tmp_path, seed=seed)
        other["task"]["yield_stress"] = stress
        synthetic.save(synthetic.synthetic_run(other, rows=synthetic.ROWS))
    with pytest.raises(MixedRunsError, match=r"task\.yield_stress, which is .* and "):
        gather(tmp_path)
    assert gather(tmp_path, "task.yield_stress=10").unusual[-1] == Setting("task.yield_stress", 10.0, "")


def test_runs_from_before_the_contact_term_had_variants_had_the_nearest(tmp_path: Path) -> None:
    for seed, terms in enumerate(({"contact": "nearest"}, None, {"contact": "soft"})):
        own = synthetic.config(tmp_path, seed=seed)
        own["method"]["loss_terms"] = terms
        if terms is None:
            del own["method"]["loss_terms"]
            # What the page's commands are made of.
            assert "method.loss_terms.contact" not in changed_settings(own)
        synthetic.save(synthetic.synthetic_run(own, rows=synthetic.ROWS))
    runs = gather(tmp_path)
    assert (len(runs.table), runs.set_aside) == (2, 1) and "loss_terms" not in str(runs.unusual)
    assert len(gather(tmp_path, "method.loss_terms.contact=nearest").table) == 2


def test_a_value_by_task_is_plabs_own_on_that_task() -> None:
    for words, changed in (
        (["task=Assembly"], {}),
        (["task=Assembly", "protocol=release"], {}),
        (["task=Assembly", "method.loss_weights.contact=1"], {"method.loss_weights.contact": 1.0}),
        (["task=Chopsticks", "method.loss_weights.contact=30"], {"method.loss_weights.contact": 30.0}),
    ):
        assert changed_settings(config_dict(load_config(words))) == changed


def test_runs_from_before_a_setting_existed_did_without(tmp_path: Path) -> None:
    for seed in range(2):
        older = synthetic.config(tmp_path, seed=seed)
        assert older["method"]["max_gradient_norm"] is None
        if seed:
            del older["method"]["max_gradient_norm"]
        synthetic.save(synthetic.synthetic_run(older, rows=synthetic.ROWS))
    runs = gather(tmp_path)
    assert len(runs.table) == 2 and "method.max_gradient_norm" not in str(runs.unusual) and not runs.set_aside


def released(folder: Path, seed: int, **changes: str) -> None:
    """Save a run of the release's protocol, with some parts of it changed."""
    config = synthetic.config(folder, seed=seed)
    own = load_config(["protocol=release", "task=Rope"])
    config["protocol"] = dataclasses.asdict(own.protocol) | changes
    config["method"]["loss_terms"] = own.method.loss_terms
    config["task"]["yield_stress"] = own.task.yield_stress
    synthetic.save(synthetic.synthetic_run(config, rows=synthetic.ROWS))


def test_protocols_are_not_mixed(tmp_path: Path) -> None:
    synthetic.save(synthetic.run(tmp_path, seed=0))
    released(tmp_path, seed=1)
    with pytest.raises(
        SelectionError, match=r"protocols plab and release: choose one, .* protocol\.name=plab"
    ):
        gather(tmp_path)
    ours, theirs = gather(tmp_path, "protocol.name=plab"), gather(tmp_path, "protocol.name=release")
    assert (len(ours.table), ours.protocol) == (1, "plab")
    assert (len(theirs.table), theirs.protocol) == (1, "release")
    assert ours.unusual == theirs.unusual == [Setting("method.iterations", synthetic.ROWS, "")]
    notes = by_form(iou_per_task(theirs))["ours"].notes
    assert "Protocol: release." in notes and "protocol's own" in notes[-1]


def test_a_changed_part_of_a_protocol_is_noted(tmp_path: Path) -> None:
    released(tmp_path, seed=0, floor="plab")
    assert Setting("protocol.floor", "plab", "") in gather(tmp_path).unusual


def test_runs_from_before_protocols_are_plabs_own(tmp_path: Path) -> None:
    for seed in range(2):
        older = synthetic.config(tmp_path, seed=seed)
        if seed:
            del older["protocol"], older["task"]["release"]
        synthetic.save(synthetic.synthetic_run(older, rows=synthetic.ROWS))
    runs = gather(tmp_path)
    assert (len(runs.table), runs.protocol, runs.set_aside) == (2, "plab", 0)


def test_settings_of_some_runs_are_not_printed_under_all(tmp_path: Path) -> None:
    for name, task, variant in (("adam", "Rope", "1"), ("gd", "Rope", "1"), ("gd", "Move", "2")):
        config = synthetic.config(tmp_path, task=task, variant=variant, method=name)
        if name == "adam":
            config["method"]["lr"] = 0.3
        if task == "Move":
            config["sim"]["particles_scale"] = 0.5
        synthetic.save(synthetic.synthetic_run(config, rows=synthetic.ROWS))
    note = by_form(iou_per_task(gather(tmp_path)))["ours"].notes[-1]
    assert note == (
        f"Settings other than plab's own: method.iterations = {synthetic.ROWS}; method.lr = 0.3 (Adam); "
        "sim.particles_scale = 0.5 (GD on Move); task.floor_friction = 0.3 (GD on Move)."
    )


# ----------------------------------------------------------------------------------------------- side by side


def two_rates(folder: Path) -> None:
    for rate, score in ((0.1, 0.4), (0.01, 0.8)):
        for seed in range(3):
            config = synthetic.config(folder, seed=seed)
            config["method"]["lr"] = rate
            synthetic.save(synthetic.synthetic_run(config, rows=synthetic.ROWS, score=score))
    synthetic.save(synthetic.run(folder, method="gd", score=0.5))


def test_two_values_of_a_setting_are_put_side_by_side(tmp_path: Path) -> None:
    two_rates(tmp_path)
    runs = collect(tmp_path, select(["task=Rope", "variant=1"], NAMES), "method.lr")
    assert runs.methods[3:6] == ["adam lr=0.01", "adam lr=0.1", "gd"]
    assert look("adam lr=0.1").label == "Adam, lr 0.1"
    assert look("adam lr=0.1").colour != look("adam lr=0.01").colour
    tables = by_form(iou_per_task(runs))
    shown = tables["ours"].cells.iloc[0]
    assert (shown["Adam, lr 0.01"], shown["Adam, lr 0.1"]) == ("0.80 ± 0.00", "0.40 ± 0.00")
    # Both are compared with what the paper has for the method; the key is no setting that needs a note.
    assert set(tables["paper"].cells.iloc[0][["Adam, lr 0.01", "Adam, lr 0.1"]]) == {"0.59 ± 0.13"}
    assert "method.lr" not in tables["ours"].notes[-1]


def test_two_folders_and_seeds_are_put_side_by_side(tmp_path: Path) -> None:
    for name, score in (("first", 0.2), ("second", 0.6)):
        for seed in range(3):
            synthetic.save(synthetic.run(tmp_path / name, seed=seed, score=score + 0.1 * seed))
    folders = [tmp_path / "first", tmp_path / "second"]
    with pytest.raises(MixedRunsError, match="same seed"):
        collect(folders, select(["task=Rope"], NAMES))
    runs = collect(folders, select(["task=Rope"], NAMES), "folder")
    assert [name for name in runs.methods if "folder" in name] == [f"adam folder={path}" for path in folders]
    assert runs.table.groupby("method")["score"].mean().tolist() == pytest.approx([0.3, 0.7])
    runs = collect(folders[:1], select(["task=Rope", "variant=1"], NAMES), "seed")
    shown = by_form(iou_per_task(runs))["ours"].cells.iloc[0]
    assert [shown[f"Adam, seed {seed}"] for seed in range(3)] == ["0.20", "0.30", "0.40"]


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("lr", "cannot split by 'lr': give a dotted key such as method.lr, or folder or seed"),
        (
            "sim.grid_size",
            "no method has runs that differ in sim.grid_size: split by a key in which they do, such as "
            "method.lr, or by folder or seed",
        ),
    ],
)
def test_nothing_to_split_gives_one_line(tmp_path: Path, capsys, key: str, line: str) -> None:
    two_rates(tmp_path)
    out = tmp_path / "out"
    assert main(["tables", "--split", key, "--results", str(tmp_path), "--out", str(out)]) == 2
    assert capsys.readouterr().err == f"plab: {line}\n"


def test_everything_is_made_of_runs_side_by_side(tmp_path: Path) -> None:
    two_rates(tmp_path / "results")
    for what in ("tables", "curves", "html"):
        words = [what, "task=Rope", "--split", "method.lr", "--results", str(tmp_path / "results")]
        more = ["--no-pictures"] if what == "html" else []
        assert main([*words, *more, "--out", str(tmp_path / what)]) == 0
    assert "Adam, lr 0.01" in (tmp_path / "tables" / "ours" / "iou_per_task.md").read_text()
    assert "Adam, lr 0.01" in (tmp_path / "html" / "index.html").read_text()
    numbers = json.loads((tmp_path / "curves" / "interquartile_mean.json").read_text())["numbers"]
    assert set(numbers) == {"adam lr=0.01", "adam lr=0.1", "gd"}


def test_two_runs_of_one_seed_are_refused(tmp_path: Path) -> None:
    for device in ("cpu", "cuda"):
        other = synthetic.config(tmp_path)
        other["sim"]["device"] = device
        synthetic.save(synthetic.synthetic_run(other, rows=synthetic.ROWS))
    with pytest.raises(MixedRunsError, match=r"have the same seed: choose one by sim\.device="):
        gather(tmp_path)
    assert len(gather(tmp_path, "sim.device=cuda").table) == 1


# ------------------------------------------------------------------------------------------------------ times


def test_times_are_per_environment_step(tmp_path: Path) -> None:
    for seed, seconds in enumerate((3.0, 4.5, 4.5)):
        result = synthetic.run(tmp_path, seed=seed)
        result.wall_time["optimise"] = seconds
        synthetic.save(result)
    tables = by_form(timing(gather(tmp_path)))
    (row,) = tables["comparison"].data.to_dict("records")
    # Three iterations of 50 steps after the first; equal times are one batch's.
    assert row["ms"] == pytest.approx(25.0) and row["measurements"] == 2
    assert row["paper_ms"] == 38.70 and row["ratio"] == pytest.approx(38.70 / 25.0)
    expected = stats.t.interval(0.95, 1, 25.0 - 38.70, 5.0 / np.sqrt(1))
    assert (row["low"], row["high"]) == pytest.approx(expected)
    cells = tables["ours"].cells.set_index("task")
    assert cells.loc["Rope", "gradient methods [ms]"] == "25.00 ± 5.00 (2)"


def test_times_say_how_many_runs_shared_a_simulator(tmp_path: Path) -> None:
    result = synthetic.run(tmp_path)
    result.provenance["batch"] = 45
    synthetic.save(result)
    cells = by_form(timing(gather(tmp_path)))["comparison"].cells
    assert cells["measured by"].to_list() == ["runs, cpu, 45 runs at once"]


@pytest.mark.parametrize("name", EXAMPLES)
def test_words_stand_for_the_archives_that_come_with_plab(name: str, tmp_path: Path, capsys) -> None:
    assert main(["tables", "--results", name, "--out", str(tmp_path)]) == 0
    # The runs with other yield stresses are for a figure of their own.
    count = len(load(example_archive(name))) - 5 * (name == "release")
    tables = 16 if name == "authors" else 17  # no method of the paper: none of agreement
    assert f"{tables} tables of {count} out of" in capsys.readouterr().out
    assert f"--results {name}" in (tmp_path / "ours" / "iou_per_task.md").read_text(encoding="utf-8")
    assert resolve(f"./{name}") == Path(name)
    assert all(problem is None for _, problem in check(example_archive(name)))


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        (
            "release",
            {
                "all gradient": ("150", "0.97", "93 %"),
                "all RL": ("150", "0.70", "91 %"),
                "PPO": ("50", "0.74", "88 %"),
                "TD3": ("50", "0.64", "94 %"),
                "SAC": ("50", "0.54", "92 %"),
            },
        ),
        ("targets", {"all": ("150", "0.45", "43 %")}),
    ],
)
def test_agreement_of_the_runs_that_come_with_plab(name: str, rows: dict[str, tuple[str, ...]]) -> None:
    """What README and docs/reproduction.md say."""
    (table,) = agreement(collect(example_archive(name), select([], NAMES)))
    cells = table.cells.set_index("method")
    page = PAGE.with_name("reproduction.md").read_text("utf-8")
    for label, row in rows.items():
        assert tuple(cells.loc[label, ["cells", "correlation", "agree"]]) == row
        assert " of ".join(row[:1] * 2) + f" | {row[1]} | {row[2]} |" in page
    assert ("all RL" in cells.index) == (name == "release")
    if name == "release":
        gradient, rl = (cells.loc[label, ["correlation", "cells"]] for label in ("all gradient", "all RL"))
        said = "correlation is {} over its {} gradient cells, {} over the {} of RL".format(*gradient, *rl)
        assert said in " ".join(README.read_text("utf-8").split())


def test_the_page_of_methods_says_what_the_runs_that_come_with_plab_reached() -> None:
    """docs/methods.md: mean scores by task, two decimals; a dash where a task was not run."""
    own, authors = load(example_archive()), load(example_archive("authors"))
    rows = re.findall(r"^\| (\w+)((?: \| (?:[\d.]+|-)){5}) \|$", PAGE.read_text("utf-8"), re.M)
    assert [task for task, _ in rows] == list(paper_table("iou_per_task")["task"].unique())
    for task, cells in rows:
        runs = own[own["task"] == task]
        means = [runs.loc[runs["method"] == m, "score"].mean() for m in ("adam", "gd", "adam_h", "solve")]
        means.append(authors.loc[authors["task"] == task, "score"].mean())
        said = ["-" if np.isnan(mean) else f"{mean:.2f}" for mean in means]
        assert cells.split(" | ")[1:] == said, task
    solved = own[own["method"] == "solve"].groupby("task")["score"].mean()
    assert (solved.round(2) >= 0.93).sum() == 9
    assert "scores 0.93 or more on nine of the ten tasks" in README.read_text("utf-8")


def test_agreement_is_within_two_deviations_or_a_tenth(tmp_path: Path) -> None:
    # The paper: 0.97 +- 0.01, 0.67 +- 0.03, 0.92 +- 0.02 for Adam; 0.04 +- 0.08 for GD.
    scores = {("1", "adam"): 0.88, ("2", "adam"): 0.56, ("5", "adam"): 0.92, ("1", "gd"): 0.19}
    for (variant, name), score in scores.items():
        synthetic.save(synthetic.run(tmp_path, task="Move", variant=variant, method=name, score=score))
    (table,) = agreement(gather(tmp_path))
    data = table.data.set_index("method")
    assert data["cells"].to_dict() == {"Adam": 3, "GD": 1, "all": 4}
    assert data["agree"].to_dict() == {"Adam": pytest.approx(2 / 3), "GD": 1.0, "all": 0.75}
    assert data.loc["Adam", "distance"] == pytest.approx((0.09 + 0.11 + 0.0) / 3)
    assert data.loc["GD", "difference"] == pytest.approx(0.15) and np.isnan(data.loc["GD", "correlation"])
    ours, papers = [0.88, 0.56, 0.92, 0.19], [0.97, 0.67, 0.92, 0.04]
    assert data.loc["all", "correlation"] == pytest.approx(np.corrcoef(ours, papers)[0, 1])


def test_benchmark_stands_beside_the_runs(folder: Path, tmp_path: Path, capsys) -> None:
    path = tmp_path / "speed.csv"
    row = {"task": "Move", "device": "cuda", "batch": 64, "forward_ms": 0.14, "gradient_ms": 0.48}
    pd.DataFrame([row]).to_csv(path, index=False)
    out = tmp_path / "out"
    assert main(["tables", "--results", str(folder), "--out", str(out), "--speed", str(path)]) == 0
    data = pd.read_csv(out / "comparison" / "timing.csv", comment="#").set_index(["task", "what"])
    assert data.loc[("Move", "forward"), "ratio"] == pytest.approx(14.26 / 0.14)
    path.write_text("task\nMove\n")
    assert main(["tables", "--results", str(folder), "--out", str(out), "--speed", str(path)]) == 2
    assert "lacks device, batch" in capsys.readouterr().err


# ----------------------------------------------------------------------------------------------- other tables


def test_solvability_is_the_recorded_demonstrations(folder: Path) -> None:
    tables = by_form(solvability(gather(folder)))
    assert tables["ours"].cells.shape == (10, 6)
    assert tables["ours"].cells.set_index("task").loc["Rope", "variant 1"] == "0.79"
    row = tables["comparison"].data.set_index(["task", "variant"]).loc[("Rope", "1")]
    assert (row["paper_method"], row["paper_mean"]) == ("adam", 0.66)
    reach = stats.t.ppf(0.975, 2) * 0.01 / np.sqrt(2)
    assert row["high"] - row["difference"] == pytest.approx(reach)


def test_hyperparameters_are_read_from_the_files() -> None:
    tables = by_form(hyperparameters())
    both = tables["comparison"].cells.set_index(["method", "key"])
    assert both.loc[("SAC", "tau")].to_list() == ["0.005", "0.0003"]
    assert both.loc[("TD3", "hidden")].to_list() == ["[256, 256]", NOTHING]
    assert both.loc[("GD", "momentum")].to_list() == ["0.9", "0.9"]
    assert both.loc[("Adam-H", "eps")].to_list() == ["1e-8", "1e-8"]
    remarks = tables["paper"].cells.set_index(["method", "key"])["remark"]
    assert remarks[("SAC", "tau")].startswith("printed; perhaps a slip")
    assert both.loc[("Adam", "lr")].to_list() == ["0.1", "0.1"]
    remarks = tables["ours"].cells.set_index(["method", "key"])["remark"]
    assert "0.01 on Chopsticks" in remarks[("Adam", "lr")] and "0.01" not in remarks[("Adam-H", "lr")]
    bold = pd.DataFrame(tables["comparison"].bold, index=both.index)
    assert bold.loc[("SAC", "tau")].any() and not bold.loc[("SAC", "gamma")].any()


# ------------------------------------------------------------------------------------------------------ files


@pytest.fixture(scope="module")
def written(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tables")
    write_tables(gather(folder, "method=adam,gd,adam_h"), out, "python -m plab.report tables")
    return out


FORMS = [
    f"{form}/iou_per_task{suffix}"
    for form in ("ours", "paper", "comparison")
    for suffix in (".tex", ".md", ".csv")
]


@pytest.mark.parametrize("name", FORMS)
def test_files_are_as_they_were(written: Path, name: str) -> None:
    """Compare with the files in tests/golden; PLAB_UPDATE_GOLDEN=1 replaces them."""
    text = re.sub(r"\b[0-9a-f]{64}\b", "0" * 64, (written / name).read_text(encoding="utf-8"))
    golden = GOLDEN / name
    if os.environ.get("PLAB_UPDATE_GOLDEN"):
        golden.parent.mkdir(parents=True, exist_ok=True)
        golden.write_text(text, encoding="utf-8", newline="\n")
    assert text == golden.read_text(encoding="utf-8")


def test_every_file_names_command_and_runs(written: Path, folder: Path) -> None:
    digest = gather(folder, "method=adam,gd,adam_h").digest
    for suffix in (".tex", ".md", ".csv", ".json"):
        text = (
            (written / "comparison" / "iou_per_configuration").with_suffix(suffix).read_text(encoding="utf-8")
        )
        assert "python -m plab.report tables" in text and digest in text
    beside = json.loads((written / "ours" / "iou_per_task.json").read_text(encoding="utf-8"))
    runs = json.loads((written / "ours" / beside["runs"]).read_text(encoding="utf-8"))
    assert len(runs) == 44 and all(Path(run["path"]).is_file() for run in runs)


def test_csv_has_all_digits(written: Path) -> None:
    data = pd.read_csv(written / "ours" / "iou_per_task.csv", comment="#").set_index(["task", "method"])
    scores = [score("Rope", v, "adam", s) for v in "12345" for s in range(3)]
    assert data.loc[("Rope", "adam"), "std"] == pytest.approx(np.std(scores), rel=1e-12)


def test_nothing_finished_gives_tables_without_numbers(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    tables = write_tables(gather(tmp_path / "empty"), tmp_path / "out", "command")
    assert len(tables) == 16
    ours = by_form([table for table in tables if table.name == "iou_per_task"])["ours"]
    assert set(ours.cells.drop(columns="task").to_numpy().ravel()) == {"0/15"}


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no TeX installation: make tex-packages")
def test_latex_compiles(written: Path, tmp_path: Path) -> None:
    shutil.copytree(written, tmp_path / "tables")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"]
    for _ in range(2):
        done = subprocess.run(
            command, cwd=tmp_path / "tables", capture_output=True, text=True, errors="replace"
        )
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "tables" / "tables.pdf").is_file()
    assert "Overfull" not in done.stdout, re.findall("Overfull.*", done.stdout)


def test_special_characters_survive_latex(tmp_path: Path) -> None:
    cells = pd.DataFrame({"a_b": ["50% & more", "x ± y"], "remark": ["{c} # $d", "e"]})
    table = Table("odd", "ours", "Odd_title", cells, cells, np.array([[True, False], [False, False]]))
    write_table(table, tmp_path, {"footer": ["f"]})
    text = (tmp_path / "ours" / "odd.tex").read_text(encoding="utf-8")
    assert r"\bfseries 50\% \& more & \{c\} \# \$d \\" in text and r"x $\pm$ y" in text
    assert "| **50% & more** | {c} # $d |" in (tmp_path / "ours" / "odd.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.126, "0.13"),
        (-0.001, "0.00"),
        (float("nan"), "\N{EN DASH}"),
        (-0.5, "\N{MINUS SIGN}0.50"),
        (1.0, "1.00"),
    ],
)
def test_numbers(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--results", "/nowhere"], "does not exist"),
        (["tusk=Rope"], "choose from: task"),
    ],
)
def test_mistakes_are_one_line(folder: Path, tmp_path: Path, capsys, arguments, message) -> None:
    default = [] if "--results" in arguments else ["--results", str(folder)]
    assert main(["tables", *arguments, *default, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_columns_of_numbers_are_on_the_right(tmp_path: Path) -> None:
    minus = "\N{MINUS SIGN}"
    cells = pd.DataFrame(
        {
            "task": ["Move", "Rope"],
            "difference": [f"{minus}0.10", NOTHING],
            "interval": [f"[{minus}0.20, +0.10]", NOTHING],
            "agree": ["65 %", "7 %"],
            "runs": ["0/15", "0.55 ± 0.30 (2/15)"],
            "verdict": ["same +0.01", "no runs"],
        }
    )
    assert "".join(aligned(cells)) == "lrrrrl"
    write_table(Table("some", "ours", "Some", cells, cells), tmp_path, {"footer": []})
    latex = (tmp_path / "ours" / "some.tex").read_text(encoding="utf-8")
    assert "{lrrrrl}" in latex and "$-$0.10" in latex and "[$-$0.20, +0.10]" in latex and minus not in latex
    lines = (tmp_path / "ours" / "some.md").read_text(encoding="utf-8").splitlines()
    assert lines[3] == "| --- | ---: | ---: | ---: | ---: | --- |" and f"{minus}0.10" in lines[4]
