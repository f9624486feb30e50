"""Assemble src/plab/sim/cuda_global.ll into the bitcode beside it, which Taichi links into its kernels."""

from pathlib import Path

import llvmlite.binding as llvm

SOURCE = Path(__file__).parents[1] / "src/plab/sim/cuda_global.ll"


if __name__ == "__main__":
    module = llvm.parse_assembly(SOURCE.read_text(encoding="utf-8"))
    module.verify()
    SOURCE.with_suffix(".bc").write_bytes(module.as_bitcode())
