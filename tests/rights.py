"""Rights to files as an ordinary user has them, also where the tests run as root."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

__all__ = ["ordinary_rights"]

OVERRIDES = 1 << 1 | 1 << 2 | 1 << 3
"""Linux's capabilities CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER: root's way past rights of files."""

VERSION = 0x20080522


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _Sets(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint32) for name in ("effective", "permitted", "inheritable"))


@contextmanager
def ordinary_rights(folder: Path) -> Iterator[None]:
    """Have this thread respect the rights of files, and give root's privilege back afterwards.

    Skips the test where nothing holds anybody back from writing to a folder that is closed.

    Args:
        folder: Where files can be made, to try it.
    """
    with _without_privilege():
        closed = folder / "tried"
        closed.mkdir(mode=0o555)
        try:
            (closed / "file").touch()
        except PermissionError:
            closed.rmdir()
        else:
            pytest.skip("this system, or this file system, has no rights of files")
        yield


@contextmanager
def _without_privilege() -> Iterator[None]:
    if sys.platform != "linux" or os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None)
    header, sets = _Header(VERSION, 0), (_Sets * 2)()
    assert libc.capget(ctypes.byref(header), sets) == 0
    before = sets[0].effective
    sets[0].effective = before & ~OVERRIDES
    assert libc.capset(ctypes.byref(header), sets) == 0
    try:
        yield
    finally:
        sets[0].effective = before
        assert libc.capset(ctypes.byref(header), sets) == 0
