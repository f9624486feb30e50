"""Write the bitcode that Taichi links into its kernels: what is assembled of src/plab/sim/cuda_global.ll, and
for CPUs what tools/stencils.py and tools/material.py make.

CPUs have a file for each platform, whose data layouts differ; their names end in a digest, since Taichi's
cache knows bitcode by the name of its file.
"""

import hashlib
from pathlib import Path

import llvmlite.binding as llvm
from llvmlite import ir
from material import MATERIAL, tracing
from stencils import STENCILS

SIM = Path(__file__).parents[1] / "src/plab/sim"
SOURCE = SIM / "cuda_global.ll"

X86 = "p270:32:32-p271:32:32-p272:64:64-i64:64-f80:128-n8:16:32:64-S128"
LAYOUTS = {
    "linux-x86_64": f"e-m:e-{X86}",
    "win32-amd64": f"e-m:w-{X86}",
    "darwin-x86_64": f"e-m:o-{X86}",
    "darwin-arm64": "e-m:o-i64:64-i128:128-n32:64-S128",
}
"""Data layouts of the platforms that Taichi has wheels for."""


def bitcode(layout: str) -> bytes:
    """All functions for a data layout."""
    module = ir.Module("plab")
    module.data_layout = layout
    with tracing():
        for real, ending in ((ir.FloatType(), "f32"), (ir.DoubleType(), "f64")):
            for make in (*STENCILS, *MATERIAL):
                make(module, f"{make.__name__}_{ending}", real)
    text = str(module).replace('target triple = "unknown-unknown-unknown"\n', "")
    parsed = llvm.parse_assembly(text)
    parsed.verify()
    return parsed.as_bitcode()


def files() -> dict[str, bytes]:
    """Names of all files, and what is in them."""
    made = {platform: bitcode(layout) for platform, layout in LAYOUTS.items()}
    return {f"{name}-{hashlib.sha256(code).hexdigest()[:8]}.bc": code for name, code in made.items()}


if __name__ == "__main__":
    module = llvm.parse_assembly(SOURCE.read_text(encoding="utf-8"))
    module.verify()
    SOURCE.with_suffix(".bc").write_bytes(module.as_bitcode())
    made = files()
    (SIM / "bitcode").mkdir(exist_ok=True)
    for old in (SIM / "bitcode").glob("*.bc"):
        old.unlink()
    for name, code in made.items():
        (SIM / "bitcode" / name).write_bytes(code)
