"""Report notebooks: measurements, and notebooks with and without runs."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

import synthetic
from plab.bench import accuracy, speed
from plab.cli.report import main
from plab.config.suite import plab_folder
from plab.report.notebooks import NOTEBOOKS
from plab.report.reference import ACCURACY, SPEED, Benchmark, origin, read_benchmark
from plab.results import ResultsError
from plab.results.examples import measurements


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    for variant in "12":
        for seed in range(3):
            which = {"task": "Rope", "variant": variant, "seed": seed}
            # The paper's Adam has 0.66 and 0.71 there.
            synthetic.save(synthetic.run(folder, score=0.67 + 0.001 * seed, method="adam", **which))
            synthetic.save(synthetic.run(folder, score=0.05 + 0.001 * seed, method="ppo", **which))
    return folder


# ---------------------------------------------------------------------------------------------- measurements


def accuracy_rows() -> pd.DataFrame:
    rows = [
        {"axis": "substeps", "task": task, "contact": contact, "precision": kind, "material": "series"}
        | {"grid": 64, "particles": 100, "substeps": steps, "ms_per_step": float(steps)}
        | {"positions": 1 / steps, "mass": 0.1, "score": 0.1, "gradient": 0.1 / steps, "angle_deg": 1.0}
        | {"outcome": outcome}
        for task in ("Move", "Rope")
        for contact in ("soft", "hard")
        for kind in ("float32", "float64")
        for steps, outcome in ((6, "not finite"), (10, "stable"), (19, "stable"))
    ]
    return pd.DataFrame(rows)


WRITTEN = {ACCURACY: accuracy.COLUMNS, SPEED: speed.PAPER_COLUMNS}


@pytest.mark.parametrize("benchmark", WRITTEN, ids=lambda benchmark: benchmark.file)
def test_files_of_benchmarks_come_with_plab_and_are_checked(tmp_path: Path, benchmark: Benchmark) -> None:
    table = read_benchmark(measurements("example") / benchmark.file, benchmark)
    file, command, *_ = origin(table)
    assert file.startswith("Measured: ") and command.startswith(benchmark.command.split(" -")[0])
    assert len(table) == {ACCURACY: len(table)}.get(benchmark, 2 * 10)
    assert set(benchmark.columns) <= set(WRITTEN[benchmark])
    path = tmp_path / benchmark.file
    path.write_text("task\nMove\n")
    with pytest.raises(ResultsError, match=str(path)):
        read_benchmark(path, benchmark)


# ------------------------------------------------------------------------------------------------- notebooks


def run_cells(name: str, monkeypatch: pytest.MonkeyPatch, **parameters: object) -> str:
    """Run a notebook's code in this process; return what it displays as text and HTML."""
    jupytext, display = pytest.importorskip("jupytext"), pytest.importorskip("IPython.display")
    shown: list[str] = []
    for place in ("IPython.display", "plab.report.notebook_cells"):
        monkeypatch.setattr(f"{place}.display", lambda thing: shown.append(str(thing.data)))
    assert display
    space: dict[str, object] = {}
    for cell in jupytext.read(plab_folder("reports") / f"{name}.py").cells:
        if cell.cell_type == "code":
            exec(compile(cell.source, name, "exec"), space)
        if "parameters" in cell.metadata.get("tags", []):
            assert set(parameters) <= set(space)
            space.update(parameters)
    return "\n".join(shown)


EXPECTED = {
    "reproduction": ("(6/15)", "Agree: within two"),
    "speed": ("benchmark, H200, float32, batch 1", "speed.csv, SHA-256"),
    "accuracy": ("accuracy.csv, SHA-256", "mean change"),
    "anatomy": ("Rope, variant", "pictures need a painter", "evaluation: score"),
}


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_show_what_there_is(name: str, results: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("plab.render.graphics.missing_graphics", lambda: "pictures need a painter")
    speed = read_benchmark(measurements("example") / SPEED.file, SPEED)
    bench, nothing = tmp_path / "bench", tmp_path / "nothing"
    bench.mkdir(), nothing.mkdir()
    for benchmark, rows in ((ACCURACY, accuracy_rows()), (SPEED, speed)):
        rows.to_csv(bench / benchmark.file, index=False)
    command = "plab report notebooks"
    text = run_cells(name, monkeypatch, RESULTS=[str(results)], BENCH=str(bench), COMMAND=command)
    assert command in text and re.search("[0-9a-f]{64}", text)
    assert all(part in text for part in EXPECTED[name])
    text = run_cells(name, monkeypatch, RESULTS=[str(nothing)], BENCH=str(nothing))
    assert text.count("There are no finished runs in") == 1
    for benchmark in {"speed": (SPEED,), "accuracy": (ACCURACY,)}.get(name, ()):
        assert f"There is no {nothing / benchmark.file}: `" in text


def test_a_folder_without_runs_is_named(tmp_path: Path, told) -> None:
    words = [str(tmp_path), "--output", str(tmp_path / "out")]
    for form in ("notebooks", "html"):
        assert str(tmp_path) in told([form, *words], main)


@pytest.mark.nightly
def test_notebooks_become_pages(tmp_path: Path) -> None:
    """Execute all four notebooks in Jupyter with the bundled results."""
    pytest.importorskip("nbclient")
    out = tmp_path / "out"
    assert main(["notebooks", "example", "--output", str(out)]) == 0
    for name in NOTEBOOKS:
        page = (out / f"{name}.html").read_text()
        assert "data:image/png;base64" in page and "plab report notebooks" in page
        assert not re.search(r"""(?:src|href)=["'](?:https?:)?//""", page) and "There is no " not in page
