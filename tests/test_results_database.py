"""The database of results: as good as reading every file, only faster; and what can be asked of it."""

from __future__ import annotations

import csv
import functools
import io
import json
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
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
    database,
    load,
    loading,
    pack,
    read,
    read_curves,
    result_path,
    rows,
    workers,
    write,
)
from plab.results.store import Store
from plab.status import survey

DATABASE = ".plab.sqlite"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three finished runs that have not changed for a while."""
    for seed in range(3):
        age(synthetic.save(synthetic.run(tmp_path / "results", seed=seed)))
    return tmp_path / "results"


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


# ---------------------------------------------------------------------------------------------- same as files


def test_second_call_opens_nothing_and_finds_the_same(folder: Path, opened: list[str]) -> None:
    keys = ["task.yield_stress", "method.lr", "nothing.here"]
    plain = load(folder, keys, database=False)
    assert len(opened) == 3
    pd.testing.assert_frame_equal(load(folder, keys), plain)
    assert len(opened) == 6
    pd.testing.assert_frame_equal(load(folder, keys), plain)
    assert len(opened) == 6
    assert [path.name for path in folder.iterdir() if path.is_file()] == [DATABASE]


def test_rows_are_those_of_the_files_to_the_last_bit(tmp_path: Path) -> None:
    # Numbers and texts that SQLite has not, or has otherwise.
    for seed, message in enumerate(["", "a\nb", "\udce9 \u00e9t\u00e9", 'in "quotes"']):
        made = synthetic.run(tmp_path, seed=seed)
        made.config["task"]["limit"], made.config["seed_scene"] = float("inf"), 2**70
        made.config["results_dir"] = f"{tmp_path}/\udce9"
        made.status, made.message = ("failed" if message else "finished"), message.replace("\udce9", "?")
        made.evaluation["loss_odd name"] = float("nan")
        made.evaluation["reward"] = -0.0
        path = tmp_path / f"seed{seed}{'.partial' if message else ''}.h5"
        write(made, path)
        age(path)
    fresh, _ = rows(tmp_path, database=False)
    for _ in range(2):
        kept, _ = rows(tmp_path)
        assert repr(kept) == repr(fresh)
    assert ask(tmp_path, "SELECT DISTINCT value FROM config WHERE key = 'seed_scene'") == [(str(2**70),)]
    assert ask(tmp_path, "SELECT DISTINCT value FROM config WHERE key = 'task.limit'") == [(float("inf"),)]


def test_configurations_share_their_sections(folder: Path) -> None:
    load(folder)
    found, _ = rows(folder)
    assert len({id(row.config["task"]) for row in found}) == 1
    assert [row.config for row in found] == [read(row.path).config for row in found]


@pytest.mark.parametrize("place", ["results", "results/", "./results", "absolute", "."])
def test_however_the_folder_is_given_there_is_one_database(folder: Path, opened, monkeypatch, place) -> None:
    load(folder)
    monkeypatch.chdir(folder if place == "." else folder.parent)
    table = load(folder if place == "absolute" else place)
    assert len(opened) == 3
    assert all(Path(path).is_file() for path in table["path"])


def test_archive_is_kept_in_the_cache(folder: Path, opened: list[str]) -> None:
    archive = folder.parent / "all.plab.zip.xz"
    pack(folder, archive)
    age(archive)
    first = load(archive, ["method.name"])
    opened.clear()
    pd.testing.assert_frame_equal(load(archive, ["method.name"]), first)
    assert not opened and not list(folder.parent.glob(".plab*"))
    (path,) = {path.rpartition(".zip")[0] for (path,) in ask(archive, "SELECT path FROM runs")}
    assert path == "all.plab"


def test_many_files_are_read_by_several_processes_in_order(folder: Path, monkeypatch) -> None:
    expected, answers, started = load(folder, database=False), [], []
    monkeypatch.setattr(workers, "_WORTH", 1)
    monkeypatch.setattr(workers, "_CHUNK", 1)
    monkeypatch.setattr(workers, "_processors", lambda: 2)
    start, asked, here = workers._start, workers._asked, loading._read
    monkeypatch.setattr(workers, "_start", lambda: started.append(start()) or started[-1])
    monkeypatch.setattr(workers, "_asked", lambda *args: answers.append(asked(*args)) or answers[-1])

    @functools.wraps(here)
    def wait(path: Path):
        # At most a minute: then the assertions below say what is wrong.
        for _ in range(6000):
            if answers:
                break
            time.sleep(0.01)
        return here(path)

    monkeypatch.setattr(loading, "_read", wait)
    pd.testing.assert_frame_equal(load(folder), expected)
    assert len(answers) in (1, 2) and len(started) == 1
    assert started[0].returncode is not None


def test_a_process_that_dies_is_replaced_by_this_one(folder: Path, monkeypatch) -> None:
    expected = load(folder, database=False)
    monkeypatch.setattr(workers, "_WORTH", 1)
    monkeypatch.setattr(workers, "_processors", lambda: 2)
    dead = [sys.executable, "-c", "raise SystemExit(1)"]
    monkeypatch.setattr(
        workers, "_start", lambda: subprocess.Popen(dead, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    )
    pd.testing.assert_frame_equal(load(folder), expected)


# -------------------------------------------------------------------------------------------------- staleness


def test_changed_new_and_removed_files_are_noticed(folder: Path, opened: list[str]) -> None:
    first = load(folder)
    replaced, removed, kept = (Path(path) for path in first["path"])
    age(synthetic.save(synthetic.run(folder, seed=0, score=0.25)))
    removed.unlink()
    new = synthetic.save(synthetic.run(folder, seed=7))
    age(new)
    opened.clear()
    table = load(folder).set_index("seed")
    assert sorted(opened) == sorted([replaced.name, new.name])
    assert list(table.index) == [0, 2, 7]
    assert table.loc[0, "score"] == pytest.approx(0.25)
    opened.clear()
    load(folder)
    assert ask(folder, "SELECT seed FROM runs ORDER BY seed") == [(0,), (2,), (7,)]
    assert ask(folder, "SELECT count(DISTINCT run) FROM all_evaluations") == [(3,)]
    assert not opened
    assert kept.exists()


def test_change_that_keeps_size_and_modification_time_is_noticed(folder: Path, opened: list[str]) -> None:
    path = Path(load(folder)["path"].iloc[0])
    before = path.stat()
    content = path.read_bytes()
    path.write_bytes(content[:-1] + b"x")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    opened.clear()
    load(folder)
    assert opened == [path.name]


def test_a_file_replaced_by_another_of_the_same_size_is_noticed(folder: Path) -> None:
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


def test_files_changed_just_now_are_there_and_are_read_again(folder: Path, opened: list[str]) -> None:
    path = synthetic.save(synthetic.run(folder, seed=9))
    load(folder)
    opened.clear()
    assert ask(folder, "SELECT count(*) FROM runs") == [(4,)]
    assert opened == [path.name]


def test_unreadable_files_are_looked_at_each_time(folder: Path) -> None:
    bad = folder / "bad.h5"
    bad.write_bytes(b"nothing")
    age(bad)
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"bad\.h5"):
            assert len(load(folder)) == 3
        with pytest.warns(UserWarning, match=r"left out 1 unreadable file\(s\): .*bad\.h5"):
            assert ask(folder, "SELECT count(*) FROM runs") == [(3,)]


def test_a_run_that_is_there_more_than_once_counts_once(folder: Path) -> None:
    for name in ("a", "b"):
        pack(folder, folder / f"{name}.plab.zip.xz")
        age(folder / f"{name}.plab.zip.xz")
    path = Path(load(folder)["path"].iloc[0])
    assert ask(folder, "SELECT count(*) FROM runs") == [(3,)]
    path.unlink()
    table = load(folder).sort_values("seed")
    found = ask(folder, "SELECT path FROM runs ORDER BY seed")
    assert [str(folder / own) for (own,) in found] == list(table["path"])
    assert ask(folder, "SELECT count(*), count(DISTINCT run) FROM iterations") == [(3 * synthetic.ROWS, 3)]


# ----------------------------------------------------------------------------------------------------- damage


def _flipped(place: int) -> Callable[[bytes], bytes]:
    return lambda image: image[:place] + bytes([image[place] ^ 1]) + image[place + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda image: b"",
        lambda image: image[:50],
        lambda image: image[: len(image) // 2],
        lambda image: image + b"more",
        lambda image: image.replace(b'"score":', b'"scorn":'),
        lambda image: b"a text\n" * 1000,
        lambda image: b"\xff" * 5000,
        *map(_flipped, (0, 20, 61, 69, 100, 5000, -1000)),
    ],
)
def test_damaged_database_is_rebuilt_silently(folder: Path, opened: list[str], recwarn, damage) -> None:
    expected = load(folder)
    path = folder / DATABASE
    path.write_bytes(damage(path.read_bytes()))
    opened.clear()
    pd.testing.assert_frame_equal(load(folder), expected)
    assert len(opened) == 3
    pd.testing.assert_frame_equal(load(folder), expected)
    assert len(opened) == 3 and not recwarn.list
    assert ask(folder, "SELECT count(*) FROM runs") == [(3,)]


def test_database_of_another_program_or_layout_is_rebuilt(folder: Path, monkeypatch) -> None:
    expected, path = load(folder), folder / DATABASE
    path.unlink()
    with closing(sqlite3.connect(path)) as foreign:
        foreign.execute("CREATE TABLE files (path, identity)")
        foreign.execute("PRAGMA application_id = 1886150498")
        foreign.commit()
    pd.testing.assert_frame_equal(load(folder), expected)
    monkeypatch.setattr("plab.results.store.SCHEMA_VERSION", 2)
    pd.testing.assert_frame_equal(load(folder), expected)
    monkeypatch.undo()
    pd.testing.assert_frame_equal(load(folder), expected)


@pytest.mark.parametrize("statement", ["DROP TABLE sections", "DELETE FROM sections", "DELETE FROM contents"])
def test_database_with_a_true_checksum_and_wrong_tables_is_rebuilt(folder: Path, statement: str) -> None:
    expected, path = load(folder), folder / DATABASE
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)
        connection.commit()
    with path.open("r+b") as file:
        with closing(Store(folder, [], DATABASE, database._LAYOUT)) as store:
            checksum = store._checksum(file)
        file.seek(60)
        file.write(checksum.to_bytes(4, "big"))
    pd.testing.assert_frame_equal(load(folder), expected)


def test_a_folder_in_its_place_is_left_alone(folder: Path, opened: list[str]) -> None:
    (folder / DATABASE / "inside").mkdir(parents=True)
    assert len(load(folder)) == len(load(folder)) == 3
    assert len(opened) == 3 and (folder / DATABASE / "inside").is_dir()


def test_folder_that_cannot_be_written_has_its_database_in_the_cache(
    folder: Path, opened: list[str], monkeypatch
) -> None:
    monkeypatch.setattr("plab.results.store.os.access", lambda path, mode: False)
    touch = Path.open

    def refuse(self: Path, *arguments, **options):
        if self.parent == folder and self.suffix == ".tmp":
            raise PermissionError(13, "Permission denied")
        return touch(self, *arguments, **options)

    monkeypatch.setattr(Path, "open", refuse)
    assert len(load(folder)) == len(load(folder)) == 3
    assert len(opened) == 3 and not (folder / DATABASE).exists()


def test_without_any_place_there_is_no_database(
    folder: Path, opened: list[str], monkeypatch, recwarn
) -> None:
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    for _ in range(2):
        assert len(load(folder)) == 3
        assert ask(folder, "SELECT avg(iteration), count(*) FROM iterations") == [(1.5, 12)]
    assert len(opened) == 12
    assert not list(folder.rglob(".plab*")) and not recwarn.list


def test_what_killed_processes_left_is_removed(folder: Path) -> None:
    old, new = folder / f"{DATABASE}.1.tmp", folder / f"{DATABASE}.2.tmp"
    old.touch(), new.touch()
    age(old, 7200.0)
    load(folder)
    assert not old.exists() and new.exists()


# --------------------------------------------------------------------------------------------- many processes

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
            time.sleep(0.01)
            if all(reader.poll() is not None for reader in readers):
                break
    finally:
        codes = [reader.wait() for reader in readers]
    assert codes == [0, 0]
    assert not list(tmp_path.rglob("*.tmp"))
    pd.testing.assert_frame_equal(load(folder), load(folder, database=False))


# ------------------------------------------------------------------------------------------------- iterations


def test_iterations_are_those_of_the_files(folder: Path, monkeypatch) -> None:
    pack(folder, folder.parent / "all.plab.zip.xz")
    age(folder.parent / "all.plab.zip.xz")
    for source in (folder, folder.parent / "all.plab.zip.xz"):
        paths = load(source)["path"].tolist()[1:]
        for _ in range(2):
            found = read_curves(source, paths)
            for path, curves in zip(paths, found, strict=True):
                expected = read(path).iterations
                pd.testing.assert_frame_equal(pd.DataFrame(curves), expected)
    # Now they are known, and nothing has to be read.
    monkeypatch.setattr("plab.results.curves.each", lambda function, items: iter([1 / 0 for _ in items]))
    assert len(read_curves(folder, load(folder)["path"].tolist()[1:])) == 2
    with pytest.raises(ZeroDivisionError):
        read_curves(folder, load(folder)["path"])


def test_iterations_of_a_changed_file_are_read_again(folder: Path) -> None:
    path = Path(load(folder)["path"].iloc[0])
    read_curves(folder, [path])
    made = synthetic.run(folder, seed=0)
    made.columns["score"] = np.full(made.rows, 0.125)
    synthetic.save(made)
    (curves,) = read_curves(folder, [path])
    assert np.unique(curves["score"]).tolist() == [0.125]


# -------------------------------------------------------------------------------------------------------- SQL


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
        assert settings["task.bodies.rope.center"] == json.dumps(
            run.config["task"]["bodies"]["rope"]["center"]
        )
        assert settings["seed"] == 0 and settings["targets.source"] is None
        rows = pd.read_sql_query(f"SELECT * FROM iterations {of_run} ORDER BY iteration", connection)
        pd.testing.assert_frame_equal(rows.drop(columns="run"), run.iterations)


def test_tables_of_several_sources_are_those_of_each(tmp_path: Path) -> None:
    one, two, archive = tmp_path / "it's", tmp_path / "two", tmp_path / "all.plab.zip.xz"
    for folder, seeds in ((one, (0, 1)), (two, (1, 2))):
        for seed in seeds:
            age(synthetic.save(synthetic.run(folder, seed=seed, score=0.25 if folder == one else 0.5)))
    pack(two, archive)
    sources = [two, archive, one]
    listed = "SELECT folder, seed, round(score, 9) FROM runs ORDER BY folder, seed"
    # Loose files that are as good as each other all stay; what an archive has beside them does not.
    assert ask(sources, listed) == [
        (str(one), 0, 0.25),
        (str(one), 1, 0.25),
        (str(two), 1, 0.5),
        (str(two), 2, 0.5),
    ]
    assert len(load(sources)) == 4
    assert ask(one, listed) == [(str(one), 0, 0.25), (str(one), 1, 0.25)]
    assert ask([archive, archive], "SELECT count(*), count(DISTINCT folder) FROM runs") == [(2, 1)]
    assert len(load([archive, archive])) == 2
    assert ask([], "SELECT folder FROM runs") == []
    for name in ("evaluations", "times", "config", "iterations"):
        values = f"SELECT runs.seed, {name}.* FROM runs JOIN {name} USING (run) WHERE folder = '{two}'"
        together, alone = ([row[:1] + row[2:] for row in ask(places, values)] for places in (sources, two))
        assert together and sorted(together, key=repr) == sorted(alone, key=repr), name
        counted = f"SELECT count(*) FROM {name} WHERE run IN (SELECT run FROM runs)"
        assert ask(sources, counted)[0][0] == ask(one, counted)[0][0] + ask(two, counted)[0][0]


def test_what_cannot_be_read_of_several_sources_is_left_out(folder: Path, tmp_path: Path, recwarn) -> None:
    bad = tmp_path / "bad.h5"
    bad.write_bytes(b"x")
    assert ask([bad, folder], "SELECT count(*) FROM runs") == [(3,)]
    assert str(recwarn.pop().message).startswith(f"left out 1 unreadable file(s): {bad}")
    with pytest.raises(ResultsError, match="truncated"):
        connect([bad, bad])
    with pytest.raises(ResultsError, match="does not exist"):
        connect([folder, tmp_path / "no"])
    with pytest.raises(ResultsError, match="a list of them, not 5"):
        connect(5)  # type: ignore[arg-type]


def test_targets_of_users_are_named_and_not_held(tmp_path: Path) -> None:
    made = synthetic.run(tmp_path)
    made.config["targets"]["source"] = "mine"
    made.masses["target"] = np.full((4, 4, 4), 0.123456789)
    path = synthetic.save(made)
    age(path)
    load(tmp_path)
    assert ask(tmp_path, "SELECT targets FROM runs") == [("mine",)]
    assert made.masses["target"].tobytes()[:16] not in (tmp_path / DATABASE).read_bytes()


@pytest.mark.parametrize(
    ("sql", "line"),
    [
        ("delete from runs", "the tables are only for reading: write a select"),
        ("drop table all_runs", "the tables are only for reading: write a select"),
        ("attach 'other.sqlite' as other", "the tables are only for reading: write a select"),
        ("pragma journal_mode = wal", "the tables are only for reading: write a select"),
        ("vacuum into 'copy.sqlite'", "the tables are only for reading: write a select"),
        ("create temp table mine (x)", "the tables are only for reading: write a select"),
        ("select from", 'near "from": syntax error'),
        ("select lr from runs", "no such column: lr"),
        (
            "select * from scores",
            "no such table: scores; there are runs, config, evaluations, times and iterations",
        ),
        ("select 1; select 2", "You can only execute one statement at a time."),
        ("-- nothing", 'there is no query: write a select, such as "select task, score from runs"'),
    ],
)
def test_sql_refuses_in_a_line(folder: Path, capsys, monkeypatch, sql: str, line: str) -> None:
    monkeypatch.chdir(folder)
    load(folder)
    before = sorted(folder.iterdir())
    assert main(["sql", sql, str(folder)]) == 2
    assert capsys.readouterr() == ("", f"plab: {line}\n")
    assert sorted(folder.iterdir()) == before


def test_sql_prints_a_table(folder: Path, capsys) -> None:
    sql = "select task, count(*) n, avg(seed) mean, null nil from runs group by task"
    assert main(["sql", sql, str(folder)]) == 0
    assert capsys.readouterr().out == "task  n  mean  nil\nRope  3     1\n"
    assert main(["sql", sql, str(folder), "--csv"]) == 0
    assert capsys.readouterr().out == "task,n,mean,nil\nRope,3,1.0,\n"
    assert main(["sql", sql, str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"task": "Rope", "n": 3, "mean": 1.0, "nil": None}]
    assert main(["sql", "select max(iteration) from iterations", str(folder)]) == 0
    assert capsys.readouterr().out.split() == ["max(iteration)", "3"]


def test_sql_says_where_there_is_nothing(tmp_path: Path, capsys) -> None:
    assert main(["sql", "select 1", str(tmp_path / "no")]) == 2
    assert capsys.readouterr().err == f"plab: there are no results: {tmp_path / 'no'} does not exist\n"
    (tmp_path / "bad.h5").write_bytes(b"x")
    assert main(["sql", "select 1", str(tmp_path / "bad.h5")]) == 2
    assert capsys.readouterr().err.startswith(f"plab: {tmp_path / 'bad.h5'} is truncated or damaged (")


# ----------------------------------------------------------------------------------------------------- scores


def test_scores(folder: Path, capsys) -> None:
    for seed, score in enumerate((0.5, 0.75, 0.25)):
        age(synthetic.save(synthetic.run(folder, seed=seed, score=score)))
    synthetic.save(synthetic.synthetic_run(synthetic.config(folder, seed=7), rows=4, finished=False))
    words = [str(folder), "seed=0,1", "--keys", "method.lr,iterations", "--sort", "score", "--descending"]
    assert main(["scores", *words]) == 0
    assert capsys.readouterr().out == (
        "task  variant  method  seed  protocol  targets  status    score  method.lr  iterations\n"
        "Rope        1  adam       1  plab               finished   0.75        0.1           4\n"
        "Rope        1  adam       0  plab               finished    0.5        0.1           4\n"
    )
    assert main(["scores", str(folder), "status=all", "--csv"]) == 0
    read = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [(row["seed"], row["status"]) for row in read] == [
        ("0", "finished"),
        ("1", "finished"),
        ("2", "finished"),
        ("7", "running"),
    ]
    assert read[-1]["score"] == ""
    assert main(["scores", str(folder), "method.lr=0.1", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [row["score"] for row in listed] == pytest.approx([0.5, 0.75, 0.25])
    assert listed[0]["targets"] is None and listed[0]["seed"] == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["--keys", "method.lt"],
            "no run has 'method.lt': give columns of plab.results.load, or dotted keys",
        ),
        (
            ["--sort", "iou"],
            "there is no column 'iou' to sort by; choose from: task, variant, method, seed, protocol, "
            "targets, status, score",
        ),
        (
            ["family=rl"],
            "'family=rl' selects nothing; choose from: task, variant, method, seed, status, or a dotted key",
        ),
    ],
)
def test_scores_refuse_in_a_line(folder: Path, capsys, words: list[str], line: str) -> None:
    assert main(["scores", str(folder), *words]) == 2
    assert capsys.readouterr() == ("", f"plab: {line}\n")


def test_folders_archives_and_example_are_taken_in_the_same_way(folder: Path, capsys) -> None:
    archive = folder.parent / "all.plab.zip.xz"
    pack(folder, archive)
    printed = []
    for source in (folder, archive):
        assert main(["scores", str(source)]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    count = len(load(example_archive()))
    assert main(["scores", "example", "--csv"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == count + 1
    assert main(["sql", "select count(*) from runs", "example", "--csv"]) == 0
    assert capsys.readouterr().out.split()[1] == str(count)
    assert status(["example", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["runs"]) > 0
    assert main(["check", "targets"]) == 0
    assert capsys.readouterr().out == "450 run(s) checked, all well\n"


def test_several_sources_are_taken_in_the_same_way(tmp_path: Path, capsys) -> None:
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
    assert status([*sources, *words, "--json"]) == 0
    known = json.loads(capsys.readouterr().out)["runs"]
    assert {run["seed"] for run in known if run["state"] == "done"} == set(scored)
    best = parse_render([str(one), str(archive), *words])
    assert read(best.result).config["seed"] == 1 and best.output == Path("Rope-v1-adam-seed1.png")


def test_pictures_are_of_the_run_with_the_highest_score(folder: Path, told, capsys) -> None:
    for seed, score in enumerate((0.5, 0.75, 0.25)):
        age(synthetic.save(synthetic.run(folder, seed=seed, score=score)))
    pack(folder, folder.parent / "all.plab.zip.xz")
    for source in (folder, folder.parent / "all.plab.zip.xz"):
        options = parse_render([str(source), "task=Rope"])
        assert read(options.result).config["seed"] == 1
        assert options.output == Path("Rope-v1-adam-seed1.png")
    assert parse_render([str(folder), "seed=2"]).output == Path("Rope-v1-adam-seed2.png")
    line = told([str(folder), "seed=3"], render)
    assert line == f"plab: there is no finished run to show in {folder}: no run fits"
    line = told(["example", "family=rl"], render)
    assert (
        line == "plab: 'family=rl' selects nothing; choose from: task, variant, method, seed, or a dotted key"
    )


def test_status_and_reports_find_the_same_with_and_without(folder: Path, opened: list[str]) -> None:
    first = survey(folder, Selection()), collect(folder, Selection())
    opened.clear()
    again = survey(folder, Selection()), collect(folder, Selection())
    assert not opened
    assert first[0] == again[0] and first[1].digest == again[1].digest
