"""Disks, folders, clocks, names and processes that misbehave: results are complete or absent, never wrong."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

import toy_runner
from faults import Failing, watched
from plab.cli import results, status
from plab.cli.run import main
from plab.config import Config, ConfigError, load_config
from plab.config.selection import select
from plab.families import FAMILIES
from plab.locks import held, lock_path
from plab.results import RunFile, load, read, result_path
from plab.runners import run_batch
from refusals import snapshot
from rights import ordinary_rights

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")
SWEEP = ("-m", *COARSE, "seed=0,1,2", "checkpoint_seconds=0")

Configs = Callable[..., list[Config]]


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Configs:
    """Let the toy runner do the work, in an empty folder; returns a function that composes runs."""
    monkeypatch.chdir(tmp_path)
    for family in FAMILIES:
        monkeypatch.setitem(FAMILIES, family, toy_runner.toy_family(family))

    def configs(*overrides: str, seeds: tuple[int, ...] = (0, 1, 2)) -> list[Config]:
        words = [*COARSE, "checkpoint_seconds=0", *overrides]
        return [load_config([*words, f"seed={seed}"]) for seed in seeds]

    return configs


def files(folder: Path = Path("results")) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


def assert_complete(cfgs: list[Config]) -> None:
    """Assert that there is each result, right, and no other file but the toy runner's log."""
    assert all(toy_runner.is_right(read(result_path(cfg)), cfg) for cfg in cfgs)
    folder = Path(cfgs[0].results_dir)
    # Whether there is a database of them depends on how old they are.
    found = {path for path in files(folder) if path.name != ".plab.sqlite"}
    assert found == {result_path(cfg) for cfg in cfgs} | {folder / "log"}


def assert_nothing_wrong(cfgs: list[Config]) -> None:
    """Assert that what there is of each run is its result, or the beginning of it."""
    for cfg in cfgs:
        path, partial = result_path(cfg), result_path(cfg).with_suffix(".partial.h5")
        if path.exists():
            assert toy_runner.is_right(read(path), cfg)
        elif partial.exists():
            losses = read(partial).iterations["loss"].tolist()
            assert losses == toy_runner.expected(cfg)[: len(losses)]
    assert not list(Path("results").rglob("*.bad*"))


def summary(out: str) -> str:
    return out.splitlines()[-1]


# ---------------------------------------------------------------- a disk that fails


@pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc")
@pytest.mark.parametrize(
    ("error", "lasting"),
    [(errno.ENOSPC, False), (errno.ENOSPC, True), (errno.EIO, False), (errno.EROFS, True)],
    ids=["full once", "full from then on", "broken once", "read-only from then on"],
)
def test_a_disk_may_fail_at_any_event(toy: Configs, monkeypatch, error: int, lasting: bool) -> None:
    """At each event of a sweep, one after the other; then the same sweep on a disk that is well."""
    monkeypatch.setattr(toy_runner, "ITERATIONS", 2)
    cfgs = toy(seeds=(0, 1))
    count = Failing(-1, error)
    with watched(Path(), count):
        assert [one.status for one in run_batch(cfgs)] == ["finished"] * 2
    kinds = {kind for kind, _ in count.seen}
    assert kinds == {"create", "write", "fsync", "replace", "unlink", "mkdir"}
    statuses = set()
    for at in range(count.count):
        for path in sorted(Path("results").rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        failing = Failing(at, error, lasting=lasting)
        with watched(Path(), failing):
            ended = run_batch(cfgs)
        for one, cfg in zip(ended, cfgs, strict=True):
            statuses.add(one.status)
            assert one.status in ("finished", "refused"), (failing.seen[at], one)
            assert (one.status == "finished") == result_path(cfg).exists(), failing.seen[at]
            if one.status == "refused":
                assert os.strerror(error) in one.message and "results/Rope-v1/adam" in one.message
        assert_nothing_wrong(cfgs)
        assert {one.status for one in run_batch(cfgs)} <= {"finished", "before"}
        assert_complete(cfgs)
    assert statuses == {"finished", "refused"}


def test_a_final_file_that_does_not_reach_the_disk_is_not_there(toy: Configs, monkeypatch, capsys) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        assert main([*SWEEP, "hydra.launcher.batch_size=1"]) == 2
    out, err = capsys.readouterr()
    assert summary(out) == "3 runs: 0 finished, 0 finished before, 3 refused"
    cfgs = toy()
    assert err.splitlines() == [
        f"plab: Rope-v1 adam seed {cfg.seed}: cannot write {result_path(cfg)}: Input/output error"
        for cfg in cfgs
    ]
    # All that was computed is kept.
    partials = [result_path(cfg).with_suffix(".partial.h5") for cfg in cfgs]
    assert files() == {*partials, Path("results/log")}
    assert [len(read(path).iterations) for path in partials] == [toy_runner.ITERATIONS] * 3
    assert main(list(SWEEP)) == 0
    assert_complete(cfgs)


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """A disk in memory, mounted by the options given; skips the test where that is not allowed."""
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("only root, on Linux, mounts a disk")
    disk = tmp_path / "disk"
    disk.mkdir()

    def mount(*options: str) -> Path:
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(disk)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            pytest.skip(f"mounting is not allowed here: {done.stderr.strip()}")
        return disk

    yield mount
    # Whoever works there keeps it from going.
    os.chdir(tmp_path)
    while disk.is_mount():
        subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_that_is_too_small_is_told_what_it_lacks(toy: Configs, mounted, capsys) -> None:
    disk = mounted("size=2m")
    assert main([*COARSE, f"results_dir={disk}/results"]) == 2
    folder = f"{disk}/results/Rope-v1/adam"
    said = f"plab: cannot write results to {folder}: No space left on device: it needs 4.2 MB\n"
    assert capsys.readouterr() == ("", said)
    assert list(disk.iterdir()) == []


def test_a_disk_that_has_become_full_and_read_only(toy: Configs, mounted, monkeypatch, capsys) -> None:
    disk = mounted("size=8m")
    monkeypatch.chdir(disk)
    filler, intact, calls = disk / "filler", toy_runner.advance, iter(range(1000))

    def advance(state):
        if next(calls) == 16:
            with filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space left"):
                while True:
                    file.write(bytes(4096))
        return intact(state)

    with monkeypatch.context() as patch:
        patch.setattr(toy_runner, "advance", advance)
        assert main([*SWEEP, "hydra.launcher.batch_size=1"]) == 2
    out, err = capsys.readouterr()
    assert summary(out) == "3 runs: 1 finished, 0 finished before, 2 refused"
    cfgs = toy()
    why, partial = "No space left on device: it needs", result_path(cfgs[1]).with_suffix(".partial.h5")
    assert err.splitlines() == [
        f"plab: Rope-v1 adam seed 1: cannot write {partial}: {why} 0.1 MB",
        f"plab: Rope-v1 adam seed 2: cannot write results to results/Rope-v1/adam: {why} 4.2 MB",
    ]
    assert_nothing_wrong(cfgs)
    filler.unlink()
    assert main(list(SWEEP)) == 0
    assert_complete(cfgs)
    before = snapshot(disk)
    # Everything is there, and nothing can be written any more.
    mounted("remount", "ro")
    capsys.readouterr()
    assert main(list(SWEEP)) == 0
    assert summary(capsys.readouterr().out) == "3 runs: 0 finished, 3 finished before"
    assert main([*COARSE, "seed=1"]) == 0
    assert main([*COARSE, "seed=3"]) == 2
    said = "plab: cannot write results to results/Rope-v1/adam: Read-only file system\n"
    assert capsys.readouterr().err == said
    assert status.main(["results", "task=Rope", "variant=1"]) == 0
    assert snapshot(disk) == before


# ---------------------------------------------------------------- folders that may not be written


@pytest.mark.parametrize("leftovers", [False, True])
def test_a_finished_sweep_in_a_closed_folder_ends_well(
    toy: Configs, tmp_path, capsys, leftovers: bool
) -> None:
    """Also where a process was killed just after it had finished a run, and nobody can clear up."""
    assert main(list(SWEEP)) == 0
    cfgs = toy()
    if leftovers:
        lock_path(result_path(cfgs[0])).touch()
        result_path(cfgs[1]).with_suffix(".partial.h5").write_bytes(result_path(cfgs[1]).read_bytes())
    before = snapshot(tmp_path)
    folders = [path for path in (tmp_path, *tmp_path.rglob("*")) if path.is_dir()]
    capsys.readouterr()
    with ordinary_rights(tmp_path):
        for folder in folders:
            folder.chmod(0o555)
        try:
            assert main(list(SWEEP)) == 0
            assert summary(capsys.readouterr().out) == "3 runs: 0 finished, 3 finished before"
            assert main([*COARSE, "seed=0"]) == 0
            assert main([*COARSE, "seed=3"]) == 2
            said = "plab: cannot write results to results/Rope-v1/adam: Permission denied\n"
            assert capsys.readouterr().err == said
            assert main([*SWEEP, "seed=2,3,4"]) == 2
            out, err = capsys.readouterr()
            assert summary(out) == "3 runs: 0 finished, 1 finished before, 2 refused"
            assert err == "".join(f"plab: Rope-v1 adam seed {seed}: {said[6:]}" for seed in (3, 4))
        finally:
            for folder in folders:
                folder.chmod(0o755)
    assert snapshot(tmp_path) == before
    # Who may write clears up, when the run is asked for.
    assert main(list(SWEEP)) == 0
    assert_complete(cfgs)


# ---------------------------------------------------------------- runs that are refused


def refuse(jobs, note) -> None:
    raise ConfigError("method.thing=1: there is no such thing; choose another")


@pytest.mark.parametrize("sweep", [(), ("-m", "seed=0,1")], ids=["run", "sweep"])
def test_a_run_that_is_refused_leaves_nothing_behind(toy: Configs, monkeypatch, capsys, sweep) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(toy_runner, "run_toy", refuse)
        assert main([*COARSE, *sweep]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert list(Path().iterdir()) == []
    assert status.main(["--json"]) == 2
    Path("results").mkdir()
    assert status.main(["--json", "task=Rope", "variant=1", "method=adam", "seed=0,1"]) == 0
    assert [run["state"] for run in json.loads(capsys.readouterr().out)["runs"]] == ["missing"] * 2


def test_what_a_refused_run_has_begun_goes_and_what_was_there_stays(
    toy: Configs, monkeypatch, capsys
) -> None:
    """A replay buffer, logs; the state of an earlier process, which can go on."""
    begun, fresh = toy(seeds=(0, 1))
    run = RunFile(begun)
    run.record({"iteration": 0, "loss": 1.0}, {"x": toy_runner.start(begun)})
    run.close("stopped", "interrupted")
    result_path(begun).with_suffix(".replay").write_bytes(b"of the earlier process")
    before = snapshot(Path())

    def begin(jobs, note) -> None:
        for job in jobs:
            replay = job.run.path.with_suffix(".replay")
            if not replay.exists():
                replay.write_bytes(bytes(1000))
            job.run.path.with_suffix(".tensorboard").mkdir()
            job.run.path.with_suffix(".tensorboard").joinpath("events").touch()
        refuse(jobs, note)

    monkeypatch.setattr(toy_runner, "run_toy", begin)
    (one,) = run_batch([fresh])
    assert (one.status, snapshot(Path())) == ("refused", before)
    (one,) = run_batch([begun])
    assert one.status == "refused"
    after = snapshot(Path())
    assert before.items() <= after.items() and not held(result_path(begun))
    assert {Path(name).suffix for name in after.keys() - before.keys()} == {".tensorboard", ""}


def test_a_run_refused_on_the_way_keeps_what_it_has_computed(toy: Configs, monkeypatch) -> None:
    intact, calls = toy_runner.advance, iter(range(100))
    monkeypatch.setattr(toy_runner, "advance", lambda x: refuse([], "") if next(calls) == 5 else intact(x))
    (cfg,) = toy("checkpoint_seconds=1000", seeds=(0,))
    (one,) = run_batch([cfg])
    assert one.status == "refused"
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, len(left.iterations)) == ("failed", 5)
    monkeypatch.setattr(toy_runner, "advance", intact)
    run_batch([cfg])
    assert_complete([cfg])


def test_networks_on_a_device_that_is_not_there_leave_nothing_behind(tmp_path, monkeypatch, capsys) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.chdir(tmp_path)
    words = ["task=Move", "method=sac", "method.torch_device=cuda"]
    said = "method.torch_device=cuda: torch finds no CUDA device; choose method.torch_device=cpu"
    assert main(words) == 2
    assert capsys.readouterr() == ("", f"plab: {said}\n")
    assert main(["-m", *words, "seed=0,1"]) == 2
    out, err = capsys.readouterr()
    assert out == "2 runs: 0 finished, 0 finished before, 2 refused\n"
    assert err == "".join(f"plab: Move-v1 sac seed {seed}: {said}\n" for seed in (0, 1))
    assert list(tmp_path.iterdir()) == []


def test_a_repetition_begins_without_the_state_that_it_replaces(toy: Configs, monkeypatch) -> None:
    """Killed on the way, it must not go on from that state: the replay buffer is its own by then."""
    (cfg,) = toy(seeds=(0,))
    run = RunFile(cfg)
    run.record({"iteration": 0, "loss": 1.0}, {"x": toy_runner.start(cfg)})
    run.close("stopped", "interrupted")
    (again,) = toy("force=true", seeds=(0,))
    RunFile(again).release()
    assert not run.partial_path.exists()


def test_a_repetition_that_is_killed_leaves_nothing_when_the_result_is_asked_for(toy: Configs) -> None:
    (cfg,) = toy(seeds=(0,))
    run_batch([cfg])
    path = result_path(cfg)
    for suffix in (".lock", ".partial.h5", ".replay", ".partial.h5.77.tmp"):
        path.with_suffix(suffix).touch()
    (one,) = run_batch([cfg])
    assert one.status == "before"
    assert_complete([cfg])


# ---------------------------------------------------------------- locks and processes


@pytest.mark.skipif(sys.platform == "win32", reason="flock")
@pytest.mark.parametrize("error", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP], ids=errno.errorcode.get)
@pytest.mark.filterwarnings("error")
def test_a_file_system_without_locks_is_told(toy: Configs, monkeypatch, capsys, error: int) -> None:
    import fcntl

    def flock(*_: int) -> None:
        raise OSError(error, os.strerror(error))

    intact = fcntl.flock
    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", flock)
        assert main([*COARSE, "seed=0"]) == 2
        said = (
            f"plab: cannot lock results/Rope-v1/adam: {os.strerror(error)}: choose a results_dir with locks\n"
        )
        assert capsys.readouterr() == ("", said)
        assert list(Path().iterdir()) == []
        patch.setattr(fcntl, "flock", intact)
        assert main(list(SWEEP)) == 0
        patch.setattr(fcntl, "flock", flock)
        # What has finished is read without a lock.
        assert main(list(SWEEP)) == 0
        assert status.main(["results", "task=Rope", "variant=1"]) == 0
    assert_complete(toy())


def start_many(count: int, argv: Sequence[str]) -> list[tuple[int, list[str]]]:
    """Give the same command to several processes at once; return exit codes, and lines on standard error."""
    children = [_start(argv, Path(f"said{number}")) for number in range(count)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    return [(code, Path(f"said{number}").read_text().splitlines()) for number, code in enumerate(codes)]


def _start(argv: Sequence[str], said: Path) -> int:
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        with open(os.devnull, "w") as nowhere, said.open("w") as err:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(err.fileno(), 2)
            sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
            code = main(list(argv))
            sys.stderr.flush()
    finally:
        os._exit(code)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.parametrize("count", [4, pytest.param(100, marks=pytest.mark.nightly)])
def test_many_processes_on_one_sweep_compute_nothing_twice(toy: Configs, monkeypatch, count: int) -> None:
    monkeypatch.setattr(toy_runner, "PAUSE", 0.005)
    seeds = tuple(range(10))
    argv = ("-m", *COARSE, f"seed=range({len(seeds)})", "checkpoint_seconds=0", "hydra.launcher.batch_size=2")
    ended = start_many(count, argv)
    # Whoever ends early says that others are at work, and nothing else.
    assert {code for code, _ in ended} <= {0, 1} and 0 in dict(ended)
    for code, lines in ended:
        assert bool(lines) == bool(code)
        assert all(line.endswith(".h5 is being computed by another process") for line in lines)
    computed = [line.split()[-1] for line in Path("results/log").read_text().splitlines()]
    assert len(computed) == len(set(computed)) == len(seeds)
    assert_complete(toy(seeds=seeds))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_two_processes_on_one_run_compute_it_once(toy: Configs, monkeypatch) -> None:
    monkeypatch.setattr(toy_runner, "PAUSE", 0.02)
    ended = start_many(2, (*COARSE, "seed=0", "checkpoint_seconds=0"))
    assert {code for code, _ in ended} <= {0, 1} and 0 in dict(ended)
    assert len(Path("results/log").read_text().splitlines()) == 1
    assert_complete(toy(seeds=(0,)))


def test_a_run_whose_process_ends_between_two_looks_is_neither_lost_nor_told_twice(
    toy: Configs, monkeypatch, capsys
) -> None:
    """A sweep looks once whether a run is under way elsewhere, and goes by that."""
    looks = iter([True, False, True])
    monkeypatch.setattr("plab.sweep.carry.held", lambda path: next(looks))
    busy = RunFile(toy(seeds=(1,))[0])
    assert main(list(SWEEP)) == 1
    out, err = capsys.readouterr()
    assert summary(out) == "3 runs: 2 finished, 0 finished before, 1 under way in another process"
    assert err.count("\n") == 1
    busy.release()


# ---------------------------------------------------------------- clocks


def test_a_clock_that_jumps_back_changes_nothing(toy: Configs, monkeypatch, capsys) -> None:
    hours, plain = iter(range(100_000)), time.time
    monkeypatch.setattr(time, "time", lambda: plain() - 3600.0 * next(hours))
    assert main([*SWEEP, "checkpoint_seconds=0.001"]) == 0
    cfgs = toy()
    assert_complete(cfgs)
    assert load("results")["score"].tolist() == [abs(toy_runner.expected(cfg)[-1]) % 1.0 for cfg in cfgs]
    # A run under way whose files are of tomorrow, and its start of the day after.
    (cfg,) = toy(seeds=(7,))
    run = RunFile(cfg)
    run.result.provenance["start_time"] = "2999-01-02T00:00:00+00:00"
    run.spend("optimise", 3.0)
    for iteration in range(3):
        run.record({"iteration": iteration, "loss": 1.0, "seconds": 1.0}, {"x": toy_runner.start(cfg)})
    os.utime(run.partial_path, (plain() + 86_400,) * 2)
    capsys.readouterr()
    assert status.main(["--json", "task=Rope", "variant=1", "method=adam", "seed=7"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["runs"]
    total = cfg.method.iterations
    assert (found["state"], found["done"], found["total"]) == ("running", 3, total)
    assert (found["rate"], found["left"], found["together"]) == (1.0, total - 3.0, 1.0)
    run.release()


# ---------------------------------------------------------------- names

NAMES = {
    "words": ' it\'s "two"\nlines [of] {1,2} (результаты) *結果? ',
    "signs": "..a=b,c:d;e&f|g#h%i$j~k!l\\m`n`.h5.partial",
}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such names")
@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("given", [False, True], ids=["working folder", "results_dir"])
def test_folders_of_any_name(toy: Configs, tmp_path, monkeypatch, capsys, name: str, given: bool) -> None:
    """As the folder in which one works, and as results_dir, quoted for Hydra."""
    folder = tmp_path / name
    quoted = name.replace("'", "\\'")
    overrides = [f"results_dir='{quoted}'"] if given else []
    if not given:
        folder.mkdir()
        monkeypatch.chdir(folder)
    where = Path(name if given else "results")
    assert main([*SWEEP, *overrides]) == 0
    assert main([*COARSE, "seed=3", "checkpoint_seconds=0", *overrides]) == 0
    assert_complete(toy(*overrides, seeds=(0, 1, 2, 3)))
    assert main([*SWEEP, "seed=0,1,2,3", *overrides]) == 0
    assert summary(capsys.readouterr().out) == "4 runs: 0 finished, 4 finished before"
    table = load(where)
    assert [Path(path).parent for path in table["path"]] == [where / "Rope-v1" / "adam"] * 4
    archive = tmp_path / f"{name}.plab.zip.xz"
    assert results.main(["pack", str(where), "--output", str(archive)]) == 0
    assert load(archive)["score"].tolist() == table["score"].tolist()
    assert results.main(["unpack", str(archive), "--output", str(tmp_path / f"{name} again")]) == 0
    assert load(tmp_path / f"{name} again")["score"].tolist() == table["score"].tolist()
    # Words with = choose runs on this command line, so that folders with one are given to the function.
    for source in (where, archive):
        found = status.survey(source, select(["task=Rope"], status.NAMES))
        assert sum(run.state == "done" for run in found.runs) == 4
