"""Curves from results: bands, aggregates, files."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import synthetic
from plab.cli.report import main
from plab.config.selection import select
from plab.report import statistics
from plab.report.collect import NAMES, collect
from plab.report.figures import rl_scores, style
from plab.report.statistics import at_budgets, band, improvement, interquartile_mean, shared_strata
from plab.report.tables import score_at_budget


def test_band_is_mean_and_spread_where_all_runs_are() -> None:
    one = pd.DataFrame({"episodes": [1, 3, 5], "reward": [0.0, 2.0, 4.0], "best_score": 0.1})
    other = pd.DataFrame({"episodes": [2, 4], "reward": [3.0, 5.0], "best_score": 0.2})
    x, mean, std = band([one, other], "episodes", "reward")
    assert x.tolist() == [2, 3, 4]
    np.testing.assert_allclose(mean, [2.0, 3.0, 4.0])
    np.testing.assert_allclose(std, [1.0, 1.0, 1.0])


def test_a_run_that_is_solved_keeps_its_last_value() -> None:
    solved = pd.DataFrame({"episodes": [1, 3], "reward": [0.0, 9.0], "best_score": [0.0, 1.0]})
    other = pd.DataFrame({"episodes": [1, 5], "reward": [0.0, 4.0], "best_score": [0.0, 0.4]})
    x, mean, _ = band([solved, other], "episodes", "reward")
    assert x.tolist() == [1, 3, 5]
    np.testing.assert_allclose(mean, [0.0, 5.5, 6.5])
    assert band([solved, solved], "episodes", "reward")[0].tolist() == [1, 3]


def test_values_below_zero_count_as_zero_run_by_run() -> None:
    rewards = [-9.0, 4.0], [1.0, -2.0]
    runs = [pd.DataFrame({"episodes": [1, 2], "reward": own, "best_score": 0.0}) for own in rewards]
    assert band(runs, "episodes", "reward")[1].tolist() == [0.5, 2.0]
    assert band(runs, "episodes", "reward", floor=None)[1].tolist() == [-4.0, 1.0]
    # No runs and runs apart give no band.
    later = runs[0].assign(episodes=[8, 9])
    assert band([], "episodes", "reward") is None and band([runs[0], later], "episodes", "reward") is None


def test_the_best_so_far_is_that_of_the_ranking_of_a_family() -> None:
    rows = pd.DataFrame({"loss": [5.0, 3.0, 3.0, 2.0], "score": [0.4, 0.1, 0.6, 0.3]})
    rows = rows.assign(episodes=range(4), steps=range(4), seconds=1.0)
    budgets = {"steps_forward": [10, 20, 30, 40], "steps_gradient": [0, 5, 5, 10]}

    def table(name: str, **more: list[float]) -> pd.DataFrame:
        own, sim = rows.assign(**budgets, **more), {"horizon": 50, "substeps": 2}
        return statistics.rows_on_axes({"method": {"family": name}, "sim": sim}, own, 2)

    assert table("trajectory")["best_score"].tolist() == [0.4, 0.1, 0.1, 0.3]
    kept = table("trajectory", kept_score=[np.nan, 0.2, 0.2, 0.5])["best_score"]
    assert kept.tolist() == [0.4, 0.2, 0.2, 0.5]
    # The best row of the external method has not the lowest loss.
    for family in ("planner", "own:FAMILY"):
        assert table(family)["best_score"].tolist() == [0.4, 0.4, 0.6, 0.6]
    spent = table("planner")
    assert spent["simulated"].tolist() == [10, 25, 35, 50] and spent["substeps"].tolist() == [20, 50, 70, 100]
    found = statistics.scores_at(spent, np.array([9.0, 10.0, 34.0, 35.0, 1e6]))
    np.testing.assert_array_equal(found, [np.nan, 0.4, 0.4, 0.6, 0.6])


def test_an_interval_over_seeds_within_variants() -> None:
    scores = np.array([[0.1, 0.3, 0.2], [0.7, 0.8, 0.6]])
    strata = [
        [pd.DataFrame({"simulated": [100.0], "best_score": [s], "seconds": [1.0]}) for s in own]
        for own in scores
    ]
    before, found = at_budgets(strata, np.array([99.0, 100.0]))
    assert np.isnan(before.value)
    # Two variances with two degrees of freedom each, equal here, so that they add up to four.
    error = np.sqrt(scores.var(axis=1, ddof=1).sum() / 3) / 2
    assert found.value == pytest.approx(scores.mean())
    assert found.high - found.value == pytest.approx(stats.t.ppf(0.975, 4) * error)
    single = at_budgets([strata[0][:1], strata[1]], np.array([100.0]))[0]
    assert single.value == pytest.approx((0.1 + 0.7) / 2) and np.isnan(single.low)


def test_table_of_scores_at_equal_budgets(tmp_path: Path) -> None:
    for seed in range(2):
        synthetic.save(synthetic.run(tmp_path, method="adam", seed=seed))
    runs = collect(tmp_path, select([], NAMES))
    (table,) = score_at_budget(runs, statistics.load_series(runs))
    (cells,) = table.cells.to_dict("records")
    assert (cells["task"], cells["method"], cells["runs"]) == ("Rope", "Adam", "2")
    data = table.data.set_index("steps")
    assert data.index.tolist() == [1e3, 1e4, 1e5, 1e6]
    # Four iterations of 50 steps: all is over before the first budget.
    assert data["score"].nunique() == 1 and cells["1,000 steps"].startswith(f"{data['score'][1e3]:.2f} [")
    assert data["seconds"][1e6] == pytest.approx(4.0, abs=0.4)


def test_interquartile_mean_is_the_mean_of_the_middle_half() -> None:
    strata = [np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.4, 0.5, 0.6, 9.0])]
    found = interquartile_mean(strata)
    assert found.value == pytest.approx(np.mean([0.2, 0.3, 0.4, 0.5]))
    assert found.low <= found.value <= found.high and interquartile_mean(strata) == found
    # No spread within configurations, however different they are: nothing is uncertain.
    found = interquartile_mean([np.full(3, value) for value in (0.0, 0.2, 0.7, 1.0)])
    assert found.low == found.value == found.high


def test_improvement_is_the_mann_whitney_statistic() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 5, 7).astype(float), rng.integers(0, 4, 5).astype(float)
    expected = stats.mannwhitneyu(a, b).statistic / (len(a) * len(b))
    found = improvement([a], [b])
    assert found.value == pytest.approx(expected) and found.low < expected < found.high
    assert improvement([a, a], [b, a]).value == pytest.approx((expected + 0.5) / 2)
    assert improvement([b], [a]).value == pytest.approx(1.0 - expected)


def test_methods_are_compared_on_what_they_share() -> None:
    rows = [("Rope", "1", "adam", 1.0), *[("Rope", "2", "adam", 0.0)] * 3, *[("Rope", "2", "gd", 0.5)] * 2]
    for others in [], [("Move", "1", "sac", 1.0)]:
        table = pd.DataFrame([*rows, *others], columns=["task", "variant", "method", "score"])
        strata, notes = shared_strata(SimpleNamespace(table=table, methods=["gd", "adam", "sac"]))
        assert {name: own[0].tolist() for name, own in strata.items()} == {"gd": [0.5] * 2, "adam": [0.0] * 3}
        assert ("SAC (0 of 1)" in notes[1]) == bool(others)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    results = tmp_path_factory.mktemp("results")
    for name, task, variant, seed in itertools.product(("ppo", "adam"), ("Rope", "Move"), "12", range(2)):
        synthetic.save(synthetic.run(results, method=name, task=task, variant=variant, seed=seed))
    return results


def test_all_figures_are_drawn_with_embedded_fonts(folder: Path, tmp_path: Path, capsys) -> None:
    more, out = tmp_path / "ablation", tmp_path / "out"
    for stress in (10.0, 200.0):
        config = synthetic.config(more, "Move", "3", "sac")
        config["task"]["yield_stress"] = stress
        synthetic.save(synthetic.synthetic_run(config, rows=synthetic.ROWS))
    words = ["task=Rope,Move", "variant=1,2,3", "method=ppo,adam,sac", "--split", "task.yield_stress"]
    assert main(["curves", *words, str(folder), str(more), "--output", str(out)]) == 0
    assert "6 figures" in capsys.readouterr().out
    assert [len(list(out.glob(f"*.{form}"))) for form in ("pdf", "png")] == [6, 6]
    for path in out.glob("*.pdf"):
        image = path.read_bytes()
        assert b"/Type3" not in image and b"/FontFile2" in image


def test_bars_are_of_tasks_with_runs_and_never_alone(folder: Path) -> None:
    with style():
        runs = collect(folder, select(["method=ppo"], NAMES))
        (drawing,) = rl_scores(runs)
        panel = drawing.figure.axes[0]
        assert [label.get_text() for label in panel.get_xticklabels()] == ["Move", "Rope"]
        papers = [m.get_offsets() for m in panel.collections if m.get_label() == "the paper"]
        assert papers[0][:, 1].tolist() == [0.69, 0.38]
        assert rl_scores(collect(folder, select(["method=ppo", "task=Rope"], NAMES))) == []
