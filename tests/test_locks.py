"""Locks of runs: one holder, gone with its process, found by those who look."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from plab.locks import acquire, held, lock_path

_HOLDER = """
import sys, time
from plab.locks import acquire
lock = acquire(sys.argv[1])
print(lock is not None, flush=True)
time.sleep(600)
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "seed0-12ab34cd.h5"


def test_final_and_partial_file_have_the_same_lock(path: Path) -> None:
    assert lock_path(path) == lock_path(path.with_suffix(".partial.h5")) == path.with_suffix(".lock")


def test_there_is_one_holder(path: Path) -> None:
    assert not held(path) and not lock_path(path).exists()
    lock = acquire(path)
    assert held(path)
    assert acquire(path) is None
    lock.release()
    assert not held(path)
    again = acquire(path)
    assert again is not None
    lock.release()
    assert held(path)
    again.release()
    assert not held(path) and not lock_path(path).exists()


def test_a_lock_that_nothing_refers_to_is_free(path: Path) -> None:
    lock = acquire(path)
    assert held(path)
    del lock
    assert not held(path)


def test_a_killed_process_holds_nothing(path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", _HOLDER, str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "True\n"
        assert held(path) and acquire(path) is None
    finally:
        process.kill()
        process.communicate()
    assert lock_path(path).exists() and not held(path)
    assert acquire(path) is not None


def test_looking_does_not_keep_anybody_from_locking(path: Path) -> None:
    code = "import sys; from plab.locks import held\nprint(flush=True)\nwhile True: held(sys.argv[1])"
    lock_path(path).touch()
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    try:
        process.stdout.readline()
        for _ in range(20):
            acquire(path).release()
    finally:
        process.kill()
        process.communicate()
