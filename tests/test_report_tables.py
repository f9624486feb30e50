"""The paper's tables from results: numbers, intervals, missing values and files."""

from __future__ import annotations

import os
import re
from functools import reduce
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import synthetic
from plab.cli.report import main
from plab.config import load_config
from plab.config.selection import lookup, select
from plab.errors import ArgumentError
from plab.report.collect import NAMES, Runs, changed_settings, collect
from plab.report.methods import method as look
from plab.report.statistics import Summary, stratified_difference, summarise
from plab.report.tables import Table, agreement, distances, hyperparameters, iou_tables, number, timing
from plab.report.writing import write_tables
from plab.results import check, config_dict, load
from plab.results.examples import EXAMPLES, resolve

GOLDEN = Path(__file__).parent / "golden"
MINUS, NOTHING = "\N{MINUS SIGN}", "\N{EN DASH}"


def score(task: str, variant: str, method: str, seed: int) -> float:
    """Return a score that is easy to verify: 0.1 per variant, 0.01 per seed, a little per method."""
    lead = {"adam": 0.05, "gd": 0.0, "adam_h": 0.02, "ppo": 0.3}[method]
    return 0.1 * int(variant) + 0.01 * seed + lead


ADAM = np.array([score("Rope", v, "adam", s) for v in "12345" for s in range(3)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All gradient runs of Rope except one, two PPO runs, an unfinished run, and a run of another variant."""
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


def save(folder: Path, settings: dict[str, object], score: float | None = None, **which: object) -> None:
    """Save a run with some settings changed, by dotted key."""
    config = synthetic.config(folder, **which)
    for key, value in settings.items():
        *sections, name = key.split(".")
        reduce(dict.__getitem__, sections, config)[name] = value
    synthetic.save(synthetic.synthetic_run(config, rows=synthetic.ROWS, score=score))


def gather(folder: Path, *words: str, split: str = "") -> Runs:
    return collect(folder, select(words, NAMES), split)


def by_form(tables: list[Table]) -> dict[str, Table]:
    return {table.form: table for table in tables}


def test_cells_per_task(folder: Path) -> None:
    runs = gather(folder)
    assert len(runs.table) == 3 * 15 - 1 + 2
    unfinished, others = runs.left_out
    assert "not finished" in unfinished and others.endswith("request them by variant=random3")
    tables = by_form(iou_tables(runs, "task"))
    rope = tables["comparison"].cells.set_index(["task", "method"]).loc["Rope"]["paper"]
    assert rope["Adam"] == "0.59 ± 0.13" and rope["PPO"] == "0.38 ± 0.19"
    row = tables["ours"].data.set_index(["task", "method"]).loc[("Rope", "adam")]
    assert row["mean"] == pytest.approx(ADAM.mean()) and row["std"] == pytest.approx(ADAM.std())
    assert (row["runs"], row["expected"]) == (15, 15)
    cells = tables["ours"].cells.set_index("task")
    assert cells.loc["Rope", "Adam"] == f"{ADAM.mean():.2f} ± {ADAM.std():.2f}"
    # Incomplete cells say how many runs they hold, and nobody is bold.
    assert cells.loc["Rope", "GD"].endswith("(14/15)")
    assert cells.loc["Move", ["PPO", "SAC"]].to_list() == ["0.45 ± 0.05 (2/15)", "0/15"]
    assert not tables["ours"].bold.any()
    table = by_form(iou_tables(gather(folder, "variant=1,2,3,4"), "task"))["ours"]
    (bold,) = table.bold[table.cells["task"] == "Rope"].tolist()
    assert bold == [False, False, False, False, True, False, False]


def test_distances_are_means_of_the_runs_that_have_them(tmp_path: Path) -> None:
    for seed in range(3):
        result = synthetic.run(tmp_path, task="Own", score=0.5, seed=seed)
        result.evaluation |= {"chamfer": 0.1 * seed} if seed else {}
        synthetic.save(result)
    (table,) = distances(gather(tmp_path))
    (row,) = table.cells.to_dict("records")
    shown = [row[name] for name in ("task", "distance", "Adam", "GD")]
    assert shown == ["Own", "Chamfer", "0.150 ± 0.050", NOTHING]
    # Tasks of one's own have the variants of their runs; methods have different colours.
    for name in ("mine", "other"):
        save(tmp_path, {"method.name": name, "task.gravity": [0.0, -9.0, 0.0]}, task="Own", variant="soft")
    runs = gather(tmp_path)
    assert runs.variants == ["1", "soft"] and look("mine").colour != look("other").colour
    assert len(gather(tmp_path, "task.gravity=[0,-9,0]").table) == 2
    assert len(gather(tmp_path, "method.max_gradient_norm=null", "method.name=mine").table) == 1


def test_differences_and_rows_per_configuration(folder: Path) -> None:
    data = by_form(iou_tables(gather(folder), "task"))["comparison"].data.set_index(["task", "method"])
    # Over the variants that both have; the paper's PPO on Move: 0.72 and 0.60 in variants 1 and 2.
    row = data.loc[("Move", "ppo")]
    assert row["difference"] == pytest.approx((0.4 - 0.72 + 0.5 - 0.60) / 2) and np.isnan(row["low"])
    row = data.loc[("Rope", "adam")]
    assert row["low"] < row["difference"] < row["high"]
    assert row["difference"] == pytest.approx(row["mean"] - np.mean([0.66, 0.71, 0.52, 0.37, 0.70]))
    tables = by_form(iou_tables(gather(folder), "configuration"))
    assert tables["ours"].cells.shape == (50, 8) and len(tables["comparison"].cells) == 300
    row = tables["ours"].data.set_index(["task", "variant", "method"]).loc[("Rope", "3", "adam_h")]
    assert row["mean"] == pytest.approx(0.33) and row["runs"] == 3
    single = tables["ours"].cells.set_index(["task", "variant"]).loc[("Move", "1"), "PPO"]
    assert single == "0.40 (1/3)"


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
    # Six variances of a mean over three runs, with two degrees of freedom each.
    reach = stats.t.ppf(0.975, 12) * np.sqrt(6 * 0.01**2 / 2) / 3
    assert (found.value, found.high) == pytest.approx((0.05, 0.05 + reach))
    # Too few runs give no interval.
    found = stratified_difference([Summary(0.5, 0.0, 1), Summary(0.2, 0.1, 3)], [Summary(0.4, 0.1, 3)] * 2)
    assert found.value == pytest.approx(-0.05) and np.isnan(found.low)
    assert np.isnan(stratified_difference([summarise([])], [Summary(0.4, 0.1, 3)]).value)


def test_mixed_settings_are_refused_with_advice(tmp_path: Path) -> None:
    key, scales = "sim.particles_scale", (0.25, 0.5)
    for seed, scale in enumerate(scales):
        save(tmp_path, {key: scale}, seed=seed)
    with pytest.raises(ArgumentError, match=r"Rope.* adam .*sim\.particles_scale=0\.25"):
        gather(tmp_path)
    runs = gather(tmp_path, f"{key}=0.5")
    assert len(runs.table) == 1 and runs.unusual == [f"method.iterations = {synthetic.ROWS}", f"{key} = 0.5"]
    assert f"{key} = 0.5" in by_form(iou_tables(runs, "task"))["ours"].notes[-1]
    # Two runs of one seed.
    save(tmp_path, {key: 0.5, "sim.device": "cuda"}, seed=1)
    with pytest.raises(ArgumentError, match=r"same seed.* sim\.device="):
        gather(tmp_path, f"{key}=0.5")


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("task.yield_stress", (200.0, 50.0, 10.0)),
        ("seed_particles", (0, 1)),
        ("task.manipulators.pillar.friction", (0.9, 0.1)),
        ("method.loss_terms", ({"contact": "nearest"}, {"contact": "soft"})),
    ],
)
def test_runs_that_try_something_are_set_aside(tmp_path: Path, key: str, values: tuple) -> None:
    for seed, value in enumerate(values):
        save(tmp_path / "results", {key: value, "method.iterations": 200}, seed=seed)
    runs = gather(tmp_path / "results")
    assert (list(runs.table["seed"]), runs.unusual) == (["0"], [])
    assert runs.left_out[0].startswith(f"{len(values) - 1} run(s) left out: more")


def test_a_value_by_task_is_plabs_own_on_that_task() -> None:
    words = ["task=Chopsticks", "method.loss_weights.contact=30"]
    assert changed_settings(config_dict(load_config(["task=Assembly"]))) == {}
    assert changed_settings(config_dict(load_config(words))) == {"method.loss_weights.contact": 30.0}


def test_protocols_are_not_mixed(tmp_path: Path) -> None:
    synthetic.save(synthetic.run(tmp_path, seed=0))
    own = config_dict(load_config(["protocol=release", "task=Rope"]))
    released = {key: lookup(own, key) for key in ("protocol", "method.loss_terms", "task")}
    save(tmp_path, released, seed=1)
    with pytest.raises(ArgumentError, match=r"plab and release: .* protocol\.name=plab"):
        gather(tmp_path)
    ours, theirs = gather(tmp_path, "protocol.name=plab"), gather(tmp_path, "protocol.name=release")
    assert (len(ours.table), ours.protocol) == (1, "plab")
    assert (len(theirs.table), theirs.protocol) == (1, "release")
    assert ours.unusual == theirs.unusual == [f"method.iterations = {synthetic.ROWS}"]
    notes = by_form(iou_tables(theirs, "task"))["ours"].notes
    assert "Protocol: release." in notes and "protocol's own" in notes[-1]
    save(tmp_path / "other", released | {"protocol.floor": "plab"})
    assert "protocol.floor = plab" in gather(tmp_path / "other").unusual


def test_two_values_of_a_setting_are_put_side_by_side(tmp_path: Path, told) -> None:
    for rate, score in ((0.1, 0.4), (0.01, 0.8)):
        for seed in range(3):
            save(tmp_path, {"method.lr": rate}, score, seed=seed)
    synthetic.save(synthetic.run(tmp_path, method="gd", score=0.5))
    runs = gather(tmp_path, "task=Rope", "variant=1", split="method.lr")
    assert runs.methods[3:6] == ["adam lr=0.01", "adam lr=0.1", "gd"]
    assert look("adam lr=0.1").label == "Adam, lr 0.1"
    assert look("adam lr=0.1").colour != look("adam lr=0.01").colour
    tables = by_form(iou_tables(runs, "task"))
    shown = tables["ours"].cells.iloc[0]
    assert (shown["Adam, lr 0.01"], shown["Adam, lr 0.1"]) == ("0.80 ± 0.00", "0.40 ± 0.00")
    # Both are compared with what the paper has for the method; the key is no setting that needs a note.
    compared = tables["comparison"].cells.set_index("method")["paper"]
    assert set(compared[["Adam, lr 0.01", "Adam, lr 0.1"]]) == {"0.59 ± 0.13"}
    assert "method.lr" not in tables["ours"].notes[-1]
    for key in ("sim.grid_size", "seed_particles"):
        assert f"differ in {key}" in told(["tables", str(tmp_path), "--split", key], main)
    runs = gather(tmp_path, "task=Rope", "seed_particles=0", "method.lr=0.1", split="seed")
    assert [name for name in runs.methods if "seed" in name][:2] == ["adam seed=0", "adam seed=1"]


def test_times_are_per_environment_step(tmp_path: Path) -> None:
    for seed, seconds in enumerate((3.0, 4.5, 4.5)):
        result = synthetic.run(tmp_path, seed=seed)
        result.wall_time["optimise"] = seconds
        synthetic.save(result)
    (table,) = timing(gather(tmp_path))
    (row,) = table.data.to_dict("records")
    # Three iterations of 50 steps after the first; equal times are one batch's.
    assert row["ms"] == pytest.approx(25.0) and row["measurements"] == 2
    assert row["paper_ms"] == 38.70 and row["ratio"] == pytest.approx(38.70 / 25.0)
    assert (row["low"], row["high"]) == pytest.approx(stats.t.interval(0.95, 1, 25.0 - 38.70, 5.0))
    assert table.cells["plab [ms]"].to_list() == ["25.00 ± 5.00 (2)"]


def test_agreement_is_within_two_deviations_or_a_tenth(tmp_path: Path) -> None:
    # The paper: 0.97 +- 0.01, 0.67 +- 0.03, 0.92 +- 0.02 for Adam; 0.04 +- 0.08 for GD.
    scores = {("1", "adam"): 0.88, ("2", "adam"): 0.56, ("5", "adam"): 0.92, ("1", "gd"): 0.19}
    for (variant, name), score in scores.items():
        synthetic.save(synthetic.run(tmp_path, task="Move", variant=variant, method=name, score=score))
    (table,) = agreement(gather(tmp_path))
    assert "Settings other than plab's own: method.iterations" in table.notes[-1]
    data = table.data.set_index("method")
    assert data["cells"].to_dict() == {"Adam": 3, "GD": 1, "all": 4}
    assert data["agree"].to_dict() == {"Adam": pytest.approx(2 / 3), "GD": 1.0, "all": 0.75}
    assert data.loc["Adam", "distance"] == pytest.approx((0.09 + 0.11 + 0.0) / 3)
    assert data.loc["GD", "difference"] == pytest.approx(0.15) and np.isnan(data.loc["GD", "correlation"])
    ours, papers = [0.88, 0.56, 0.92, 0.19], [0.97, 0.67, 0.92, 0.04]
    assert data.loc["all", "correlation"] == pytest.approx(np.corrcoef(ours, papers)[0, 1])
    # One run each; the paper's three runs have the unbiased variance 3/2 std^2.
    noise, spread = 1.5 * np.mean(np.square([0.01, 0.03, 0.02, 0.08])), np.var(papers, ddof=1)
    expected = (spread - noise / 3) / np.sqrt(spread * (spread - noise / 3 + noise))
    assert data.loc["all", "expected"] == pytest.approx(expected) and np.isnan(data.loc["GD", "expected"])


def test_hyperparameters_are_read_from_the_files() -> None:
    (table,) = hyperparameters()
    both = table.cells.set_index(["method", "key"])
    assert both.loc[("SAC", "tau")].to_list() == ["0.005", "0.0003"]
    assert both.loc[("TD3", "hidden")].to_list() == ["[256, 256]", NOTHING]
    assert both.loc[("GD", "momentum")].to_list() == ["0.9", "0.9"]
    rates = both["plab"]
    assert "0.01 on Chopsticks" in rates[("Adam", "lr")] and "0.01" not in rates[("Adam-H", "lr")]
    bold = pd.DataFrame(table.bold, index=both.index)
    assert bold.loc[("SAC", "tau")].any() and not bold.loc[("SAC", "gamma")].any()


AGREEMENT = {
    "all gradient": ("150", "0.97", "0.96", "97 %"),
    "all RL": ("150", "0.79", "0.65", "93 %"),
    "PPO": ("50", "0.95", "0.86", "92 %"),
    "TD3": ("50", "0.64", "0.42", "94 %"),
    "SAC": ("50", "0.54", "0.40", "92 %"),
}
"""Cells, correlation with the paper, expected one, agreement of ``release``; also in docs/reproduction.md."""


@pytest.mark.parametrize(
    "name", ["authors", *(pytest.param(n, marks=pytest.mark.nightly) for n in EXAMPLES if n != "authors")]
)
def test_words_stand_for_the_archives_that_come_with_plab(name: str, tmp_path: Path, capsys) -> None:
    assert main(["tables", name, "--output", str(tmp_path)]) == 0
    # The runs with other yield stresses are for a figure of their own.
    count = len(load(name)) - 5 * (name == "release")
    # None of agreement without a method of the paper.
    tables = {"authors": 9}.get(name, 10)
    assert f"{tables} tables of {count} out of" in capsys.readouterr().out
    if name != "authors":
        assert all(not problem for _, problem in check(resolve(name)))
    page = (Path(__file__).parents[1] / "docs" / "reproduction.md").read_text("utf-8")
    for label, row in AGREEMENT.items() if name == "release" else ():
        (table,) = agreement(gather(resolve(name)))
        cells = table.cells.set_index("method")
        assert tuple(cells.loc[label, ["cells", "correlation", "expected", "agree"]]) == row
        assert " | ".join((f"{row[0]} of {row[0]}", *row[1:])) in page


@pytest.fixture(scope="module")
def written(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tables")
    write_tables(gather(folder, "method=adam,gd,adam_h"), out, "python -m plab.report tables")
    return out


@pytest.mark.parametrize("form", ["ours", "comparison"])
def test_files_are_as_they_were(written: Path, form: str) -> None:
    """Compare with the files in tests/golden; PLAB_UPDATE_GOLDEN=1 replaces them."""
    for suffix in (".tex", ".csv"):
        name = f"{form}/iou_per_task{suffix}"
        text = re.sub(r"\b[0-9a-f]{64}\b", "0" * 64, (written / name).read_text(encoding="utf-8"))
        golden = GOLDEN / name
        if os.environ.get("PLAB_UPDATE_GOLDEN"):
            golden.parent.mkdir(parents=True, exist_ok=True)
            golden.write_text(text, encoding="utf-8", newline="\n")
        assert text == golden.read_text(encoding="utf-8")


def test_numbers_have_two_decimals_and_a_minus_sign() -> None:
    values = (0.126, -0.001, float("nan"), -0.5, 1.0)
    assert [number(value) for value in values] == ["0.13", "0.00", NOTHING, f"{MINUS}0.50", "1.00"]
