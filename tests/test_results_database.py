"""Results as tables: as good as reading every file, only faster; SQL, scores and pictures of them."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import synthetic
from plab.cli.render import _parse as parse_render
from plab.cli.render import main as render
from plab.cli.results import main
from plab.cli.status import main as status
from plab.config.selection import Selection
from plab.examples import example_archive
from plab.report.collect import collect
from plab.results import (
    ResultsError,
    connect,
    load,
    loading,
    pack,
    read,
    read_curves,
    result_path,
    rows,
    write,
)
from plab.status import survey


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three finished runs that have not changed for a while."""
    for seed in range(3):
        age(synthetic.save(synthetic.run(tmp_path / "results", seed=seed)))
    return tmp_path / "results"


@pytest.fixture
def scored(folder: Path) -> Path:
    """Three finished runs that score 0.5, 0.75 and 0.25."""
    for seed, score in enumerate((0.5, 0.75, 0.25)):
        age(synthetic.save(synthetic.run(folder, seed=seed, score=score)))
    return folder


def age(path: Path, seconds: float = 60.0) -> None:
    """Make a file look as if it was last changed so long ago."""
    stat = path.stat()
    os.utime(path, (stat.st_atime - seconds, stat.st_mtime - seconds))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are opened."""
    names: list[str] = []
    read = loading.read_rows

    def counting(path: Path):
        names.append(path.name)
        return read(path)

    monkeypatch.setattr(loading, "read_rows", counting)
    return names


def ask(source: Path | list[Path], sql: str) -> list[tuple]:
    with closing(connect(source, iterations="iterations" in sql)) as connection:
        return connection.execute(sql).fetchall()


# --------------------------------------------------------------------------------------------- same as files


def test_second_call_opens_nothing_and_finds_the_same(folder: Path, opened: list[str], monkeypatch) -> None:
    archive = folder.parent / "all.plab.zip.xz"
    pack(folder, archive)
    age(archive)
    keys, digests = ["task.yield_stress", "method.lr", "nothing.here"], set()
    for source in (folder, archive):
        plain = load(source, keys, database=False)
        pd.testing.assert_frame_equal(load(source, keys), plain)
        opened.clear()
        pd.testing.assert_frame_equal(load(source, keys), plain)
        assert survey(source, Selection()).runs
        digests.add(collect(source, Selection()).digest)
        assert not opened
    assert len(digests) == 1 and collect(folder, Selection({"seed": ["0"]}, {})).digest not in digests
    # However the folder is given.
    monkeypatch.chdir(folder.parent)
    for place in ("results/", "./results"):
        assert all(Path(path).is_file() for path in load(place)["path"])
    monkeypatch.chdir(folder)
    assert len(load(".")) == 3 and not opened


def test_rows_are_those_of_the_files_to_the_last_bit(tmp_path: Path) -> None:
    # Numbers and texts that a database has not, or has otherwise.
    for seed, message in enumerate(["", "a\nb", "\u00e9t\u00e9", 'in "quotes"']):
        made = synthetic.run(tmp_path, seed=seed)
        made.config["task"]["limit"], made.config["seed_scene"] = float("inf"), 2**70
        made.config["results_dir"] = f"{tmp_path}/\udce9"
        made.status, made.message = ("failed" if message else "finished"), message
        made.evaluation |= {"loss_odd name": float("nan"), "reward": -0.0}
        path = tmp_path / f"seed{seed}{'.partial' if message else ''}.h5"
        write(made, path)
        age(path)
    fresh, _ = rows(tmp_path, database=False)
    for _ in range(2):
        kept, _ = rows(tmp_path)
        assert repr(kept) == repr(fresh)
    assert [row.config for row in kept] == [read(row.path).config for row in kept]
    assert ask(tmp_path, "SELECT DISTINCT value FROM config WHERE key = 'seed_scene'") == [(str(2**70),)]
    assert ask(tmp_path, "SELECT DISTINCT value FROM config WHERE key = 'task.limit'") == [(float("inf"),)]


# ------------------------------------------------------------------------------------------------- staleness


def test_changed_new_and_removed_files_are_noticed(folder: Path, opened: list[str]) -> None:
    first = load(folder)
    read_curves(folder, first["path"])
    replaced, removed, kept = (Path(path) for path in first["path"])
    made = synthetic.run(folder, seed=0, score=0.25)
    made.columns["score"] = np.full(made.rows, 0.125)
    synthetic.save(made)
    removed.unlink()
    new = synthetic.save(synthetic.run(folder, seed=7))
    opened.clear()
    table = load(folder).set_index("seed")
    assert sorted(opened) == sorted([replaced.name, new.name])
    assert list(table.index) == [0, 2, 7]
    assert table.loc[0, "score"] == pytest.approx(0.25)
    assert ask(folder, "SELECT seed FROM runs ORDER BY seed") == [(0,), (2,), (7,)]
    curves, unchanged = read_curves(folder, [replaced, kept])
    assert np.unique(curves["score"]).tolist() == [0.125]
    pd.testing.assert_frame_equal(pd.DataFrame(unchanged), read(kept).iterations)


def test_files_that_change_places_are_noticed(folder: Path) -> None:
    one, other, _ = (Path(path) for path in load(folder)["path"])
    size = max(one.stat().st_size, other.stat().st_size)
    for path in (one, other):
        path.write_bytes(path.read_bytes().ljust(size, b"\0"))
        os.utime(path, (1e9, 1e9))
    load(folder)
    between = folder / "between"
    one.rename(between), other.rename(one), between.rename(other)
    pd.testing.assert_frame_equal(load(folder), load(folder, database=False))
    assert ask(folder, "SELECT count(DISTINCT seed) FROM runs") == [(3,)]


def test_unreadable_files_are_named_each_time(folder: Path) -> None:
    bad = folder / "bad.h5"
    bad.write_bytes(b"nothing")
    age(bad)
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"bad\.h5"):
            assert len(load(folder)) == 3
        with pytest.warns(UserWarning, match=r"left out 1 unreadable file\(s\): .*bad\.h5"):
            assert ask(folder, "SELECT count(*) FROM runs") == [(3,)]
    with pytest.raises(ResultsError, match=r"bad\.h5"):
        connect([bad, bad])
    with pytest.raises(ResultsError, match="nowhere"):
        connect([folder, folder / "nowhere"])


def test_a_damaged_database_is_rebuilt_silently(folder: Path, recwarn) -> None:
    expected = load(folder)
    for path in (path for path in folder.iterdir() if path.is_file()):
        path.write_bytes(path.read_bytes()[:5000] + b"x" * 99)
    pd.testing.assert_frame_equal(load(folder), expected)
    assert ask(folder, "SELECT count(*) FROM runs") == [(3,)] and not recwarn.list


_READER = """
import sys
from contextlib import closing
from plab.results import connect, load
for _ in range(6):
    seeds = load(sys.argv[1])["seed"].tolist()
    assert set(seeds) >= {0, 1, 2}, seeds
    with closing(connect(sys.argv[1])) as connection:
        (count,), = connection.execute("SELECT count(*) FROM runs WHERE seed < 3")
    assert count == 3, count
"""


def test_processes_at_once(folder: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PLAB_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-W", "error", "-c", _READER, str(folder)]
    readers = [subprocess.Popen(command, env=environment) for _ in range(2)]
    try:
        # Runs come, change and go all the while.
        for seed in (seed for _ in range(1000) for seed in range(3, 9)):
            path = synthetic.save(synthetic.run(folder, seed=seed))
            os.utime(path, (1e9, 1e9))
            result_path(synthetic.config(folder, seed=3 + (seed - 1) % 6)).unlink(missing_ok=True)
            time.sleep(0.05)
            if all(reader.poll() is not None for reader in readers):
                break
    finally:
        codes = [reader.wait() for reader in readers]
    assert codes == [0, 0]
    pd.testing.assert_frame_equal(load(folder), load(folder, database=False))


# ------------------------------------------------------------------------------------------------------- SQL


def test_tables(folder: Path) -> None:
    path = load(folder)["path"].iloc[0]
    run = read(path)
    row = dict(load(folder).iloc[0])
    with closing(connect(folder, iterations=True)) as connection:
        table = pd.read_sql_query("SELECT * FROM runs WHERE seed = 0", connection)
        (number,) = table["run"]
        for name in ("task", "variant", "method", "score", "iou", "config_hash", "status", "iterations"):
            assert table[name].tolist() == [row[name]], name
        assert (folder / table["path"][0]) == Path(path)
        assert table[["protocol", "targets"]].values.tolist() == [["plab", None]]
        of_run = f"WHERE run = {number}"
        evaluation = dict(connection.execute(f"SELECT name, value FROM evaluations {of_run}").fetchall())
        assert evaluation == run.evaluation
        times = dict(connection.execute(f"SELECT phase, seconds FROM times {of_run}").fetchall())
        assert times == run.wall_time
        settings = dict(connection.execute(f"SELECT key, value FROM config {of_run}").fetchall())
        assert settings["method.lr"] == run.config["method"]["lr"]
        center = run.config["task"]["bodies"]["rope"]["center"]
        assert json.loads(settings["task.bodies.rope.center"]) == center
        assert settings["seed"] == 0 and settings["targets.source"] is None
        rows = pd.read_sql_query(f"SELECT * FROM iterations {of_run} ORDER BY iteration", connection)
        pd.testing.assert_frame_equal(rows.drop(columns="run"), run.iterations)


def test_tables_of_several_sources_are_those_of_each(tmp_path: Path) -> None:
    one, two, archive = tmp_path / "it's", tmp_path / "two", tmp_path / "all.plab.zip.xz"
    for folder, seeds in ((one, (0, 1)), (two, (1, 2))):
        for seed in seeds:
            made = synthetic.run(folder, seed=seed, score=0.25 if folder == one else 0.5)
            made.config["targets"]["source"] = "mine" if seed == 0 else None
            age(synthetic.save(made))
    pack(two, archive)
    sources = [two, archive, one]
    listed = "SELECT folder, seed, round(score, 9), targets FROM runs ORDER BY folder, seed"
    of_one = [(str(one), 0, 0.25, "mine"), (str(one), 1, 0.25, None)]
    # Loose files that are as good as each other all stay; what an archive has beside them does not.
    assert ask(sources, listed) == [*of_one, *((str(two), seed, 0.5, None) for seed in (1, 2))]
    assert len(load(sources)) == 4
    assert ask(one, listed) == of_one
    assert ask([archive, archive], "SELECT count(*), count(DISTINCT folder) FROM runs") == [(2, 1)]
    for name in ("evaluations", "times", "config", "iterations"):
        values = f"SELECT runs.seed, {name}.* FROM runs JOIN {name} USING (run) WHERE folder = '{two}'"
        together, alone = ([row[:1] + row[2:] for row in ask(places, values)] for places in (sources, two))
        assert together and sorted(together, key=repr) == sorted(alone, key=repr), name


def test_sql_refuses_in_a_line(folder: Path, told, monkeypatch) -> None:
    monkeypatch.chdir(folder)
    load(folder)
    for sql, named in (
        ("delete from runs", "reading"),
        ("drop table all_runs", "reading"),
        ("attach 'other.sqlite' as other", "reading"),
        ("vacuum into 'copy.sqlite'", "reading"),
        ("select from", '"from"'),
        ("select lr from runs", "lr"),
        ("select * from scores", "runs, config, evaluations, times and iterations"),
        ("select 1; select 2", "one statement"),
        ("-- nothing", "no query"),
    ):
        assert named in told(["sql", sql, str(folder)], main)


def test_sql_prints_a_table(folder: Path, told, capsys) -> None:
    sql = "select task, count(*) n, avg(seed) mean, null nil from runs group by task"
    assert main(["sql", sql, str(folder)]) == 0
    assert capsys.readouterr().out == "task  n  mean  nil\nRope  3     1\n"
    assert main(["sql", sql, str(folder), "--csv"]) == 0
    assert capsys.readouterr().out == "task,n,mean,nil\nRope,3,1.0,\n"
    assert main(["sql", sql, str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"task": "Rope", "n": 3, "mean": 1.0, "nil": None}]
    assert main(["sql", "select max(iteration) from iterations", str(folder)]) == 0
    assert capsys.readouterr().out.split() == ["max(iteration)", "3"]
    (folder / "bad.h5").write_bytes(b"x")
    for place in ("no", "bad.h5"):
        assert str(folder / place) in told(["sql", "select 1", str(folder / place)], main)


# -------------------------------------------------------------------------------------- scores and pictures


def test_scores(scored: Path, told, capsys) -> None:
    synthetic.save(synthetic.synthetic_run(synthetic.config(scored, seed=7), rows=4, finished=False))
    words = [str(scored), "seed=0,1", "--keys", "method.lr,iterations", "--sort", "score", "--descending"]
    assert main(["scores", *words]) == 0
    assert capsys.readouterr().out == (
        "task  variant  method  seed  protocol  targets  status    score  method.lr  iterations\n"
        "Rope        1  adam       1  plab               finished   0.75        0.1           4\n"
        "Rope        1  adam       0  plab               finished    0.5        0.1           4\n"
    )
    assert main(["scores", str(scored), "status=all", "--csv"]) == 0
    read = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [(row["seed"], row["status"]) for row in read] == [
        *((seed, "finished") for seed in "012"),
        ("7", "running"),
    ]
    assert read[-1]["score"] == ""
    assert main(["scores", str(scored), "method.lr=0.1", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [row["score"] for row in listed] == pytest.approx([0.5, 0.75, 0.25])
    assert listed[0]["targets"] is None and listed[0]["seed"] == 0
    for words in (["--keys", "method.lt"], ["--sort", "iou"], ["family=rl"]):
        assert words[-1] in told(["scores", str(scored), *words], main)


def test_folders_archives_and_example_are_taken_in_the_same_way(tmp_path: Path, capsys) -> None:
    one, archive = tmp_path / "one", tmp_path / "two.plab.zip.xz"
    age(synthetic.save(synthetic.run(one, seed=0, score=0.5)))
    age(synthetic.save(synthetic.run(tmp_path / "two", seed=1, score=0.75)))
    pack(tmp_path / "two", archive)
    sources = [str(one), str(archive), "example"]
    words = ["task=Rope", "variant=1", "method=adam", "sim.precision=float32"]
    assert main(["scores", *sources, *words, "--csv"]) == 0
    scored = {
        row["seed"]: float(row["score"]) for row in csv.DictReader(io.StringIO(capsys.readouterr().out))
    }
    assert {"0", "1"} <= set(scored)
    assert main(["sql", "select folder, count(*) from runs group by folder", *sources, "--csv"]) == 0
    counted = dict(csv.reader(io.StringIO(capsys.readouterr().out)))
    assert counted.pop(str(one)) == counted.pop(str(archive)) == "1" and len(counted) == 2
    assert str(len(load(example_archive()))) in counted.values()
    assert status([*sources, *words, "--json"]) == 0
    known = json.loads(capsys.readouterr().out)["runs"]
    assert {run["seed"] for run in known if run["state"] == "done"} == set(scored)
    best = parse_render([str(one), str(archive), *words])
    assert read(best.result).config["seed"] == 1 and best.output == Path("Rope-v1-adam-seed1.png")


def test_pictures_are_of_the_run_with_the_highest_score(scored: Path, told) -> None:
    pack(scored, scored.parent / "all.plab.zip.xz")
    for source in (scored, scored.parent / "all.plab.zip.xz"):
        options = parse_render([str(source), "task=Rope"])
        assert read(options.result).config["seed"] == 1
        assert options.output == Path("Rope-v1-adam-seed1.png")
    assert parse_render([str(scored), "seed=2"]).output == Path("Rope-v1-adam-seed2.png")
    assert str(scored) in told([str(scored), "seed=3"], render)
    assert "family=rl" in told(["example", "family=rl"], render)
