"""Write the bitcode that Taichi links into its kernels: what is assembled of src/plab/sim/cuda_global.ll, and
what tools/stencils.py makes."""

from pathlib import Path

import llvmlite.binding as llvm
import stencils

SIM = Path(__file__).parents[1] / "src/plab/sim"
SOURCE = SIM / "cuda_global.ll"


if __name__ == "__main__":
    module = llvm.parse_assembly(SOURCE.read_text(encoding="utf-8"))
    module.verify()
    SOURCE.with_suffix(".bc").write_bytes(module.as_bitcode())
    for old in (SIM / "stencils").glob("*.bc"):
        old.unlink()
    for name, code in stencils.files().items():
        (SIM / "stencils").mkdir(exist_ok=True)
        (SIM / "stencils" / name).write_bytes(code)
