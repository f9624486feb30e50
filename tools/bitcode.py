"""Write the bitcode that Taichi links into its kernels: for CUDA what is assembled of tools/cuda_global.ll
and what tools/particle.py makes, for CPUs what tools/stencils.py and tools/material.py make.

CPUs have a file for each platform, whose data layouts differ. Names end in a digest, since Taichi's cache
knows bitcode by the name of its file.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import llvmlite.binding as llvm
from llvmlite import ir
from material import MATERIAL
from particle import PARTICLE
from stencils import STENCILS

FOLDER = Path(__file__).parents[1] / "src/plab/sim/bitcode"

X86 = "p270:32:32-p271:32:32-p272:64:64-i64:64-f80:128-n8:16:32:64-S128"
LAYOUTS = {
    "linux-x86_64": f"e-m:e-{X86}",
    "win32-amd64": f"e-m:w-{X86}",
    "darwin-x86_64": f"e-m:o-{X86}",
    "darwin-arm64": "e-m:o-i64:64-i128:128-n32:64-S128",
}
"""Data layouts of the platforms that Taichi has wheels for."""


def assembled(makers: Iterable, layout: str = "") -> llvm.ModuleRef:
    """What makes functions, made for both precisions, for a data layout."""
    module = ir.Module("plab")
    module.data_layout = layout
    for real, ending in ((ir.FloatType(), "f32"), (ir.DoubleType(), "f64")):
        for make in makers:
            make(module, f"{make.__name__}_{ending}", real)
    return llvm.parse_assembly(str(module).replace('target triple = "unknown-unknown-unknown"\n', ""))


def files() -> dict[str, bytes]:
    """Names of all files, and what is in them."""
    modules = {name: assembled((*STENCILS, *MATERIAL), layout) for name, layout in LAYOUTS.items()}
    source = Path(__file__).with_name("cuda_global.ll").read_text(encoding="utf-8")
    modules["cuda"] = llvm.parse_assembly(source)
    modules["cuda"].link_in(assembled(PARTICLE))
    made = {}
    for name, module in modules.items():
        module.verify()
        code = module.as_bitcode()
        made[f"{name}-{hashlib.sha256(code).hexdigest()[:8]}.bc"] = code
    return made


if __name__ == "__main__":
    for old in FOLDER.glob("*.bc"):
        old.unlink()
    for name, code in files().items():
        (FOLDER / name).write_bytes(code)
