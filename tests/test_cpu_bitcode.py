"""Bitcode for the CPU: that it is what its source makes. What it computes is compared with CUDA's phases in
``test_kernel_pairs.py``, and with the reference and central differences elsewhere."""

import sys
from pathlib import Path

import pytest

from plab.sim import cpu_bitcode


def test_bitcode_is_that_of_its_source(monkeypatch) -> None:
    pytest.importorskip("llvmlite", reason="no llvmlite of that LLVM for this Python")
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "tools")
    import bitcode

    folder = Path(cpu_bitcode.__file__).parent / "bitcode"
    assert bitcode.files() == {path.name: path.read_bytes() for path in folder.iterdir()}


def test_environments_share_a_copy_which_is_that_of_the_package(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path / "cache"))
    copied = Path(cpu_bitcode._file())
    original = Path(cpu_bitcode.__file__).parent / "bitcode" / copied.name
    assert copied.parent == tmp_path / "cache" and copied.read_bytes() == original.read_bytes()
    copied.write_bytes(b"of somebody else")
    assert Path(cpu_bitcode._file()).read_bytes() == original.read_bytes()
    assert [path.name for path in copied.parent.iterdir()] == [copied.name]
    (tmp_path / "file").touch()
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path / "file"))
    assert cpu_bitcode._file() == str(original)


def test_a_platform_without_bitcode_is_told(monkeypatch) -> None:
    monkeypatch.setattr(sys, "platform", "sunos5")
    with pytest.raises(ImportError, match="plab's simulator has no code for sunos5-"):
        cpu_bitcode._file()
