"""Bitcode for the CPU: that it is what its source makes. What it computes is compared with CUDA's phases in
``test_kernel_pairs.py``, and with the reference and central differences elsewhere."""

import sys
from pathlib import Path

import pytest

from plab.sim import cpu_stencils


def test_bitcode_is_that_of_its_source(monkeypatch) -> None:
    pytest.importorskip("llvmlite", reason="no llvmlite of that LLVM for this Python")
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "tools")
    import stencils

    folder = Path(cpu_stencils.__file__).parent / "stencils"
    assert stencils.files() == {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_platform_without_bitcode_is_told(monkeypatch) -> None:
    monkeypatch.setattr(sys, "platform", "sunos5")
    with pytest.raises(ImportError, match="plab's simulator has no code for sunos5-"):
        cpu_stencils._file()
