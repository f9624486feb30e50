"""Full and read-only disks, killed processes, damaged files, locks: results are complete or absent."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

import toy_runner
from faults import KILL, Failing, contents, watched
from plab.cli import status
from plab.cli.run import main
from plab.config import Config, ConfigError
from plab.locks import acquire, held, lock_path
from plab.results import SCHEMA_VERSION, RunFile, read, result_path
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


def begun(cfg: Config) -> RunFile:
    """Return the file of a run with one iteration, released by its process."""
    run = RunFile(cfg)
    run.record({"iteration": 0, "loss": 1.0}, {"x": toy_runner.start(cfg)})
    run.close("stopped", "interrupted")
    return run


@pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc")
@pytest.mark.parametrize(
    ("error", "lasting"),
    [
        pytest.param(KILL, False, id="killed"),
        pytest.param(errno.ENOSPC, True, id="full"),
        pytest.param(errno.ENOSPC, False, id="full once", marks=pytest.mark.nightly),
        pytest.param(errno.EIO, False, id="broken once", marks=pytest.mark.nightly),
        pytest.param(errno.EROFS, True, id="read-only", marks=pytest.mark.nightly),
    ],
)
def test_a_batch_is_completed_after_a_failure_at_any_event(monkeypatch, error: int, lasting: bool) -> None:
    """Failure at each change of a file, one after the other, then the same batch undisturbed."""
    monkeypatch.setattr(toy_runner, "ITERATIONS", 2)
    cfgs = configs("checkpoint_seconds=0", seeds=(0, 1) if error else (0,))
    count = Failing(-1, error)
    with watched(Path(), count):
        run_batch(cfgs)
    assert set(count.seen) == {"create", "write", "fsync", "replace", "unlink", "mkdir"}
    want, ends = contents(RESULTS), set()
    for at in range(len(count.seen)):
        shutil.rmtree(RESULTS)
        if error:
            with watched(Path(), Failing(at, error, lasting=lasting)):
                ended = run_batch(cfgs)
            ends |= {one.status for one in ended}
            for one, cfg in zip(ended, cfgs, strict=True):
                assert (one.status == "finished") == result_path(cfg).exists(), count.seen[at]
                if one.status == "refused":
                    assert os.strerror(error) in one.message and "results/Rope-v1/adam" in one.message
                    assert one.message.endswith(" MB") == (error == errno.ENOSPC)
        else:
            assert killed(cfgs, at)
        for cfg in cfgs:
            path, partial = result_path(cfg), result_path(cfg).with_suffix(".partial.h5")
            if left := next((one for one in (path, partial) if one.exists()), None):
                losses = read(left).iterations["loss"].tolist()
                assert losses == toy_runner.expected(cfg)[: len(losses)]
                assert left == partial or len(losses) == 2
        assert all(one.finished for one in run_batch(cfgs))
        assert contents(RESULTS) == want, count.seen[at]
    assert ends == ({"finished", "refused"} if error else set())
    assert_complete(cfgs)


def killed(cfgs: list[Config], at: int) -> bool:
    """Run a batch in a process of its own; returns whether it was killed, at the event of this number."""
    child = os.fork()
    if child == 0:
        try:
            with watched(Path(), Failing(at, KILL)):
                run_batch(cfgs)
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


@pytest.mark.skipif(sys.platform != "linux", reason="follows descriptors in /proc")
def test_a_finished_sweep_on_a_disk_that_is_read_only_ends_well(capsys) -> None:
    """Also with leftovers of a process that was killed just after it had finished a run."""
    assert main(list(SWEEP)) == 0
    cfgs = configs()
    path = result_path(cfgs[1])
    lock_path(result_path(cfgs[0])).touch()
    for suffix in (".lock", ".partial.h5", ".replay", ".partial.h5.77.tmp"):
        path.with_suffix(suffix).write_bytes(path.read_bytes())
    before = snapshot(Path())
    with watched(Path(), Failing(0, errno.EROFS, lasting=True)):
        assert main(list(SWEEP)) == 0
        assert main([*COARSE, "seed=0"]) == 0
        assert status.main(["results", "task=Rope", "variant=1"]) == 0
        capsys.readouterr()
        assert main([*SWEEP, "seed=2,3"]) == 2
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "2 runs: 0 finished, 1 finished before, 1 refused"
    assert err.count("\n") == 1 and "results/Rope-v1/adam" in err
    assert snapshot(Path()) == before
    # A process that may write clears up.
    assert main(list(SWEEP)) == 0
    assert_complete(cfgs)


def test_damaged_files_are_computed_again_and_newer_ones_left_alone(capsys, caplog) -> None:
    assert main(list(SWEEP)) == 0
    cfgs = configs()
    cut, newer = (result_path(cfg) for cfg in cfgs[:2])
    cut.write_bytes(cut.read_bytes()[:1000])
    with h5py.File(newer, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1
    before = newer.read_bytes()
    capsys.readouterr()
    assert main(list(SWEEP)) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and str(newer) in err
    assert newer.read_bytes() == before and str(cut) in caplog.text
    aside = cut.with_name(f"{cut.name}.bad")
    assert aside.stat().st_size == 1000
    aside.unlink()
    newer.unlink()
    assert main(list(SWEEP)) == 0
    assert_complete(cfgs)


# ---------------------------------------------------------------- refused and repeated runs


def refuse(*_: object) -> None:
    raise ConfigError("method.thing=1: there is no such thing; choose another")


@pytest.mark.parametrize("sweep", [(), ("-m", "seed=0,1")], ids=["run", "sweep"])
def test_a_refused_run_leaves_nothing_behind(monkeypatch, capsys, sweep: tuple[str, ...]) -> None:
    monkeypatch.setattr(toy_runner, "run_toy", refuse)
    assert main([*COARSE, *sweep]) == 2
    assert "method.thing" in capsys.readouterr().err
    assert list(Path().iterdir()) == []


def test_files_of_a_refused_run_are_removed_unless_an_earlier_process_left_them(monkeypatch) -> None:
    old, fresh = configs(seeds=(0, 1))
    begun(old)
    result_path(old).with_suffix(".replay").write_bytes(b"of the earlier process")
    before = snapshot(Path())

    def begin(jobs) -> None:
        for job in jobs:
            job.run.path.with_suffix(".replay").touch()
            job.run.path.with_suffix(".tensorboard").mkdir()
            job.run.path.with_suffix(".tensorboard").joinpath("events").touch()
        refuse()

    monkeypatch.setattr(toy_runner, "run_toy", begin)
    assert [one.status for one in run_batch([fresh])] == ["refused"]
    assert snapshot(Path()) == before
    assert [one.status for one in run_batch([old])] == ["refused"]
    assert before.items() <= snapshot(Path()).items() and not held(result_path(old))


def test_a_run_refused_on_the_way_keeps_its_iterations() -> None:
    (cfg,) = configs("checkpoint_seconds=1000", seeds=(0,))
    with raising(ConfigError("method.thing=1"), 5, toy_runner, "advance"):
        assert [one.status for one in run_batch([cfg])] == ["refused"]
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, left.rows) == ("failed", 5)
    run_batch([cfg])
    assert_complete([cfg])


def test_a_repetition_begins_without_the_state_that_it_replaces() -> None:
    """A repetition that is killed must not go on from that state, as its replay buffer is another one."""
    (cfg,), (again,) = configs(seeds=(0,)), configs("force=true", seeds=(0,))
    run = begun(cfg)
    assert run.partial_path.exists()
    RunFile(again).release()
    assert not run.partial_path.exists()


# ---------------------------------------------------------------- locks


def started(code: str) -> subprocess.Popen:
    """Start a process that prints a line as soon as it is ready, and wait for that."""
    code = f"import time; from plab.locks import acquire, held; {code}"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


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


def test_a_killed_process_holds_nothing_and_looking_keeps_nobody_from_locking() -> None:
    process = started("lock = acquire('run.h5'); print('ready', flush=True); time.sleep(600)")
    assert held("run.h5") and acquire("run.h5") is None
    process.kill()
    process.communicate()
    assert lock_path("run.h5").exists() and not held("run.h5")
    lock_path("run.h5").touch()
    process = started("print('ready', flush=True)\nwhile True: held('run.h5')")
    for _ in range(20):
        acquire("run.h5").release()
    process.kill()
    process.communicate()


@pytest.mark.skipif(sys.platform == "win32", reason="flock")
@pytest.mark.parametrize("error", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP], ids=errno.errorcode.get)
def test_a_file_system_without_locks_is_refused(told, monkeypatch, error: int) -> None:
    def flock(*_: int) -> None:
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr("fcntl.flock", flock)
    line = told([*COARSE])
    assert "results_dir" in line and os.strerror(error) in line
