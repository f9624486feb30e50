"""Result tables: equality with reading every file, speed of the index, SQL, scores and pictures."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from argparse import Namespace
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

import synthetic
from plab.cli.results import main
from plab.cli.rollouts import render, resolve_rollout
from plab.config.selection import Selection
from plab.report.collect import collect
from plab.report.statistics import load_series
from plab.results import ResultsError, connect, load, pack, read, read_curves, rows, run_table, write
from plab.status import survey


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three finished runs with scores 0.5, 0.75 and 0.25 that have not changed for a while."""
    for seed, score in enumerate((0.5, 0.75, 0.25)):
        age(synthetic.save(synthetic.run(tmp_path / "results", seed=seed, score=score)))
    return tmp_path / "results"


def age(path: Path, seconds: float = 60.0) -> None:
    """Set a file's modification time to some time ago."""
    stat = path.stat()
    os.utime(path, (stat.st_atime - seconds, stat.st_mtime - seconds))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files opened."""
    names: list[str] = []
    read = run_table.read_each

    def counting(path: Path, extract: Callable):
        names.append(path.name)
        return read(path, extract)

    monkeypatch.setattr(run_table, "read_each", counting)
    return names


def ask(source: Path | list[Path], sql: str) -> list[tuple]:
    with closing(connect(source, iterations="iterations" in sql)) as connection:
        return connection.execute(sql).fetchall()


def test_second_call_opens_nothing_and_finds_the_same(folder: Path, opened: list[str]) -> None:
    archive = folder.parent / "all.plab.zip.xz"
    pack(folder, archive)
    age(archive)
    keys, digests = ["task.yield_stress", "method.lr"], set()
    for source in (folder, archive):
        plain = load(source, keys, index=False)
        pd.testing.assert_frame_equal(load(source, keys), plain)
        opened.clear()
        pd.testing.assert_frame_equal(load(source, keys), plain)
        assert len(survey(source, Selection()).runs) == 3
        digests.add(collect(source, Selection()).digest)
        assert not opened
    assert len(digests) == 1 and collect(folder, Selection({"seed": ["0"]}, {})).digest not in digests


def test_rows_are_those_of_the_files_to_the_last_bit(tmp_path: Path) -> None:
    # Numbers and texts that a table has otherwise.
    for seed, message in enumerate(["", "a\nb", "\u00e9t\u00e9", 'in "quotes"']):
        made = synthetic.run(tmp_path, seed=seed)
        made.config["task"]["limit"], made.config["seed_scene"] = float("inf"), 2**70
        made.status, made.message = ("failed" if message else "finished"), message
        made.evaluation |= {"loss_odd name": float("nan"), "reward": -0.0}
        path = tmp_path / f"seed{seed}{'.partial' if message else ''}.h5"
        write(made, path)
        age(path)
    fresh, _ = rows(tmp_path, index=False)
    for _ in range(2):
        kept, _ = rows(tmp_path)
        assert repr(kept) == repr(fresh)
    assert [row.config for row in kept] == [read(row.path).config for row in kept]
    assert ask(tmp_path, "SELECT DISTINCT value FROM config WHERE key = 'seed_scene'") == [(str(2**70),)]
    assert ask(tmp_path, "SELECT DISTINCT number FROM config WHERE key = 'task.limit'") == [(float("inf"),)]


def test_changed_new_and_removed_files_are_noticed(folder: Path, opened: list[str]) -> None:
    first = load(folder)
    read_curves(first["path"])
    replaced, removed, kept = (Path(path) for path in first["path"])
    made = synthetic.run(folder, seed=0, score=0.25)
    made.columns["score"] = np.full(made.rows, 0.125)
    synthetic.save(made)
    removed.unlink()
    new = synthetic.save(synthetic.run(folder, seed=7))
    opened.clear()
    table = load(folder).set_index("seed")
    assert sorted(opened) == sorted([replaced.name, new.name]) and list(table.index) == [0, 2, 7]
    assert table.loc[0, "score"] == pytest.approx(0.25)
    assert ask(folder, "SELECT seed FROM runs ORDER BY seed") == [(0,), (2,), (7,)]
    curves, unchanged = read_curves([replaced, kept])
    assert np.unique(curves["score"]).tolist() == [0.125]
    pd.testing.assert_frame_equal(pd.DataFrame(unchanged), read(kept).iterations)


def test_unreadable_files_are_named_each_time(folder: Path) -> None:
    bad = folder / "bad.h5"
    bad.write_bytes(b"nothing")
    age(bad)
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"bad\.h5"):
            assert len(load(folder)) == 3
        with pytest.warns(UserWarning, match=r"skipped 1 unreadable file\(s\): .*bad\.h5"):
            assert ask(folder, "SELECT count(*) FROM runs") == [(3,)]
    with pytest.raises(ResultsError, match="nowhere"):
        connect([folder, folder / "nowhere"])


def test_runs_without_iterations_are_queried(folder: Path) -> None:
    for kept in (folder, folder.parent / "alone"):
        synthetic.save(replace(synthetic.run(kept, seed=9), columns={}, status="running"))
    for source, counts in ((folder, (4, 3)), (folder.parent / "alone", (1, 0))):
        assert ask(source, "SELECT count(*) FROM runs") == [counts[:1]]
        assert ask(source, "SELECT count(DISTINCT run) FROM iterations") == [counts[1:]]


def test_a_run_with_damaged_iterations_is_named_and_left_out_everywhere(folder: Path) -> None:
    path = synthetic.save(synthetic.run(folder, seed=9))
    with h5py.File(path) as file:
        place = file["iterations/reward"].id.get_chunk_info(0).byte_offset
    image = bytearray(path.read_bytes())
    image[place + 2] ^= 0xFF
    path.write_bytes(image)
    with pytest.warns(UserWarning, match=rf"skipped 1 unreadable .*{path.name}"):
        assert len(load(folder)) == 3
    with pytest.warns(UserWarning, match=path.name):
        assert ask(folder, "SELECT count(DISTINCT run) FROM iterations") == [(3,)]
    found, (packed, bad) = collect(folder, Selection()), pack(folder, folder.parent / "all.plab.zip.xz")
    assert len(load_series(found)) == 3 and path.name in found.left_out[-1]
    assert packed == 3 and path.name in str(bad)


def test_a_damaged_index_is_rebuilt_silently(folder: Path, recwarn) -> None:
    expected = load(folder)
    for path in (path for path in folder.iterdir() if path.is_file()):
        path.write_bytes(path.read_bytes()[:5000] + b"x" * 99)
    pd.testing.assert_frame_equal(load(folder), expected)
    assert ask(folder, "SELECT count(*) FROM runs") == [(3,)] and not recwarn.list


def test_tables(folder: Path) -> None:
    row = dict(load(folder).iloc[0])
    run = read(path := row["path"])
    with closing(connect(folder, iterations=True)) as connection:
        table = connection.sql("SELECT * FROM runs WHERE seed = 0").df()
        (number,) = table["run"]
        for name in ("task", "variant", "method", "score", "iou", "config_hash", "status", "iterations"):
            assert table[name].tolist() == [row[name]], name
        assert (folder / table["path"][0]) == Path(path)
        assert table["protocol"].tolist() == ["plab"] and table["targets"].isna().all()
        of_run = f"WHERE run = {number}"
        for name, value in run.evaluation.items():
            assert table["score_best" if name == "score" else name].tolist() == [value], name
        for name, value in run.wall_time.items():
            assert table[f"seconds_{name}"].tolist() == [value]
        settings = dict(connection.execute(f"SELECT key, value FROM config {of_run}").fetchall())
        assert float(settings["method.lr"]) == run.config["method"]["lr"]
        center = run.config["task"]["bodies"]["rope"]["center"]
        assert json.loads(settings["task.bodies.rope.center"]) == center
        assert settings["seed"] == "0" and settings["targets.source"] is None
        rows = connection.sql(f"SELECT * EXCLUDE run FROM iterations {of_run} ORDER BY iteration").df()
        pd.testing.assert_frame_equal(rows, run.iterations)


def test_tables_of_several_sources_are_those_of_each(tmp_path: Path) -> None:
    one, two, archive = tmp_path / "it's", tmp_path / "two", tmp_path / "all.plab.zip.xz"
    for folder, seeds in ((one, (0, 1)), (two, (1, 2))):
        for seed in seeds:
            made = synthetic.run(folder, seed=seed, score=0.25 if folder == one else 0.5)
            made.config["targets"]["source"] = "mine" if seed == 0 else None
            age(synthetic.save(made))
    pack(two, archive)
    sources = [two, archive, one, one / "Rope-v1"]
    listed = "SELECT folder, seed, round(score, 9), targets FROM runs ORDER BY folder, seed"
    of_one = [(str(one), 0, 0.25, "mine"), (str(one), 1, 0.25, None)]
    # Loose files that are as good as each other all stay; what an archive has beside them does not.
    assert ask(sources, listed) == [*of_one, *((str(two), seed, 0.5, None) for seed in (1, 2))]
    assert len(load(sources)) == 4
    for name in ("config", "iterations"):
        values = f"SELECT {name}.* FROM runs JOIN {name} USING (run) WHERE folder = '{two}'"
        together, alone = (sorted(row[1:] for row in ask(places, values)) for places in (sources, two))
        assert together and together == alone, name


def test_sql_prints_a_table(folder: Path, told, capsys) -> None:
    for sql, named in (("select lr from runs", "lr"), ("select * from scores", "config"), ("", "empty")):
        assert named in told(["sql", sql, str(folder)], main)
    sql = "select task, count(*) n, sum(0.5) mean, null nil, date '2026-12-01' d from runs group by task"
    assert main(["sql", sql, str(folder)]) == 0
    assert capsys.readouterr().out == "task  n  mean  nil  d\nRope  3   1.5       2026-12-01\n"
    assert main(["sql", sql, str(folder), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row == {"task": "Rope", "n": 3, "mean": 1.5, "nil": None, "d": "2026-12-01"}
    assert str(folder / "no") in told(["sql", "select 1", str(folder / "no")], main)
    odd = f"PYTHONIOENCODING=ascii {sys.executable} -m plab results sql 'select chr(27)||chr(177) a' {folder}"
    assert subprocess.run(odd, shell=True, stdout=subprocess.PIPE).stdout == b"a\n\\xb1\n"
    assert subprocess.run(f"{odd} >&-", shell=True).returncode == 0
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)  # by xdist
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert main(["sql", "select count(*) from range(100000000000) a, range(100000000)", str(folder)]) == 130
    signal.signal(signal.SIGINT, ignored)


def test_scores(folder: Path, told, capsys) -> None:
    synthetic.save(synthetic.synthetic_run(synthetic.config(folder, seed=7), rows=4, finished=False))
    words = [str(folder), "seed=0,1", "--keys", "method.lr,iterations", "--sort", "score", "--descending"]
    assert main(["scores", *words]) == 0
    assert capsys.readouterr().out == (
        "task  variant  method  seed  protocol  targets  status    score  method.lr  iterations\n"
        "Rope        1  adam       1  plab               finished   0.75        0.1           4\n"
        "Rope        1  adam       0  plab               finished    0.5        0.1           4\n"
    )
    words = ["status=all", "--json", "--sort", "status", "--descending"]
    assert main(["scores", str(folder), *words]) == 0
    _, *listed = json.loads(capsys.readouterr().out)
    # Runs that are equal in what they are sorted by are in their usual order.
    assert [(row["status"], row["seed"]) for row in listed] == [("finished", seed) for seed in range(3)]
    assert [row["score"] for row in listed] == pytest.approx([0.5, 0.75, 0.25])
    assert listed[0]["targets"] is None
    for words in (["--keys", "method.lt"], ["--sort", "iou"], ["task=Ropee"]):
        assert words[-1].rpartition("=")[2] in told(["scores", str(folder), *words], main)


def test_pictures_are_of_the_run_with_the_highest_score(folder: Path, told) -> None:
    pack(folder, folder.parent / "all.plab.zip.xz")
    for source in (folder, folder.parent / "all.plab.zip.xz"):
        options = Namespace(config_dir=None, what=[str(source), "task=Rope"], output=None)
        assert resolve_rollout(options, ".png") == Path("Rope-v1-adam-seed1.png")
        assert read(options.source).config["seed"] == 1
    assert str(folder) in told([str(folder), "seed=3"], render)
