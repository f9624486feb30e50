"""Full and read-only disks, killed processes, damaged files and locks: results are complete or absent."""

from __future__ import annotations

import errno
import fcntl
import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import h5py
import pytest

import toy_runner
from faults import DEATH, Death, Failing, contents, watched
from plab.cli import status
from plab.cli.run import main
from plab.config import ConfigError
from plab.results import RunFile, read, run_file
from plab.results.running import acquire, held, lock_path
from plab.runners import run_batch
from refusals import snapshot
from same_runs import raising
from toy_runner import COARSE, assert_complete, configs

RESULTS = Path("results")
SWEEP = ("-m", *COARSE, "seed=0,1,2", "checkpoint_seconds=0")


@pytest.fixture(autouse=True)
def _toy_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    toy_runner.install(monkeypatch)


@pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc")
@pytest.mark.parametrize(
    ("error", "lasting"),
    [
        pytest.param(DEATH, True, id="killed", marks=pytest.mark.nightly),
        pytest.param(errno.ENOSPC, True, id="full"),
        pytest.param(errno.EIO, False, id="broken once", marks=pytest.mark.nightly),
    ],
)
def test_a_batch_is_completed_after_a_failure_at_any_event(monkeypatch, error: int, lasting: bool) -> None:
    """Fail at each file operation in turn, then run the same batch undisturbed."""
    monkeypatch.setattr(toy_runner, "ITERATIONS", 2)
    cfgs = configs("checkpoint_seconds=0", seeds=(0,) if error == DEATH else (0, 1))
    count = Failing(-1, error)
    with watched(Path(), count):
        run_batch(cfgs)
    assert set(count.seen) == {"create", "write", "fsync", "replace", "unlink", "mkdir"}
    want, ends = contents(RESULTS), set()
    for at in range(len(count.seen)):
        shutil.rmtree(RESULTS)
        ended = []
        try:
            with watched(Path(), Failing(at, error, lasting=lasting)):
                ended = run_batch(cfgs)
        except Death:
            # Locks that nothing refers to are free, as are those of a process that is gone.
            gc.collect()
        ends |= {one.status for one in ended}
        for one in ended:
            assert (one.status == "finished") == Path(one.path).exists(), count.seen[at]
            if one.status == "refused":
                assert os.strerror(error) in one.message and "results/Rope-v1/adam" in one.message
        for cfg in cfgs:
            path, partial = cfg.path, cfg.path.with_suffix(".partial.h5")
            if left := next((one for one in (path, partial) if one.exists()), None):
                losses = list(read(left).columns.get("loss", ()))
                assert losses == toy_runner.expected(cfg)[: len(losses)]
                assert left == partial or len(losses) == 2
        assert all(one.finished for one in run_batch(cfgs))
        assert contents(RESULTS) == want, count.seen[at]
    assert ends == (set() if error == DEATH else {"finished", "refused"})
    assert_complete(cfgs)


@pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc")
def test_a_finished_sweep_on_a_disk_that_is_read_only_ends_well(capsys) -> None:
    """Include leftovers of a process that was killed just after finishing a run."""
    assert main(list(SWEEP)) == 0
    cfgs = configs()
    lock_path(cfgs[0].path).touch()
    for suffix in (".lock", ".partial.h5", ".replay", ".partial.h5.77.tmp"):
        cfgs[1].path.with_suffix(suffix).write_bytes(cfgs[1].path.read_bytes())
    before = snapshot(Path())
    with watched(Path(), Failing(0, errno.EROFS, lasting=True)):
        assert main(list(SWEEP)) == 0 == status.main(["results", "task=Rope", "variant=1"])
        capsys.readouterr()
        assert main([*SWEEP, "seed=2,3"]) == 2
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "2 runs: 0 finished, 1 finished before, 1 refused"
    assert err.count("\n") == 1 and "results/Rope-v1/adam" in err and snapshot(Path()) == before
    # A process that may write clears up.
    assert main(list(SWEEP)) == 0
    assert_complete(cfgs)


def test_damaged_files_are_computed_again_and_newer_and_locked_ones_left_alone(capsys, caplog) -> None:
    assert main(list(SWEEP)) == 0
    cut, newer, locked = (cfg.path for cfg in configs())
    cut.write_bytes(cut.read_bytes()[:1000])
    with h5py.File(newer, "r+") as file:
        file.attrs["schema_version"] = run_file.SCHEMA_VERSION + 1
    before = newer.read_bytes(), locked.read_bytes()
    capsys.readouterr()
    with locked.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert main(list(SWEEP)) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 2 and str(newer) in err and str(locked) in err
    assert (newer.read_bytes(), locked.read_bytes()) == before and str(cut) in caplog.text
    aside = cut.with_name(f"{cut.name}.bad")
    assert aside.stat().st_size == 1000
    aside.unlink()
    newer.unlink()
    assert main(list(SWEEP)) == 0
    assert_complete(configs())


def test_files_of_a_refused_run_are_removed_unless_an_earlier_process_left_them(monkeypatch, capsys) -> None:
    (old,) = configs("checkpoint_seconds=1000", seeds=(0,))
    with raising(ConfigError("method.thing=1"), 5, toy_runner, "advance"):
        assert [one.status for one in run_batch([old])] == ["refused"]
    left = read(old.path.with_suffix(".partial.h5"))
    assert (left.status, left.rows) == ("failed", 5)

    def refuse(jobs) -> None:
        for job in jobs:
            job.run.path.with_suffix(".replay").touch()
            job.run.path.with_suffix(".tensorboard").mkdir()
        raise ConfigError("method.thing=1: there is no such thing; choose another")

    with monkeypatch.context() as patch:
        patch.setattr(toy_runner, "run_toy", refuse)
        before = snapshot(Path())
        assert main([*COARSE, "seed=1"]) == main(["-m", *COARSE, "seed=2,3"]) == 2
        assert snapshot(Path()) == before and "method.thing" in capsys.readouterr().err
        assert [one.status for one in run_batch([old])] == ["refused"]
        assert before.items() <= snapshot(Path()).items() and not held(old.path)
    shutil.rmtree(old.path.with_suffix(".tensorboard"))
    old.path.with_suffix(".replay").unlink()
    run_batch([old])
    assert_complete([old])


def test_a_repetition_begins_without_the_state_that_it_replaces() -> None:
    """A killed repetition must not resume from that state, because its replay buffer differs."""
    cfg = configs(seeds=(0,))[0]
    run = RunFile(cfg)
    run.record({"iteration": 0, "loss": 1.0}, {"x": toy_runner.start(cfg)})
    run.close("stopped", "interrupted")
    assert read(run.partial_path).rows == 1
    RunFile(configs("force=true", seeds=(0,))[0]).release()
    assert read(run.partial_path).rows == 0


def test_a_lock_has_one_holder_until_it_is_released_or_forgotten() -> None:
    file = lock_path("run.h5")
    assert file == lock_path("run.partial.h5") == Path("run.lock")
    assert not held("run.h5") and not file.exists()
    lock = acquire("run.h5")
    assert held("run.h5") and acquire("run.h5") is None
    lock.release()
    assert not held("run.h5") and not file.exists()
    again = acquire("run.h5")
    lock.release()
    assert held("run.h5")
    del again
    assert not held("run.h5")


def test_a_killed_process_holds_nothing(monkeypatch) -> None:
    code = "import plab.results.running as m; lock = m.acquire('run.h5'); print('ready', flush=True); input()"
    pipes = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
    process = subprocess.Popen([sys.executable, "-c", code], text=True, **pipes)
    assert process.stdout.readline() == "ready\n" and held("run.h5") and acquire("run.h5") is None
    with monkeypatch.context() as patch:
        # As if the file belonged to another user.
        patch.setattr("plab.results.running.acquire", Mock(side_effect=PermissionError))
        assert held("run.h5")
        process.kill()
        process.communicate()
        assert not held("run.h5")
    assert lock_path("run.h5").exists() and not held("run.h5")
