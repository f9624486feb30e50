"""LLVM bitcode files that Taichi links into its kernels, written on first use.

A file contains the functions of the transfers or of one law, for one device and one precision. Its name in
plab's cache folder contains a digest of its sources. Taichi identifies compiled kernels by these names, so
editing a formula triggers recompilation.

Taichi 1.7 has LLVM 15, compatible with bitcode from llvmlite 0.42 to 0.44; Quadrants has LLVM 22, as llvmlite
0.50.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import os
import platform
import re
import sys
import tempfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from plab import laws
from plab.errors import ConfigError
from plab.files import cache_dir
from plab.laws import Law
from plab.sim.compiler import QUADRANTS

if TYPE_CHECKING:
    from plab.sim.codegen.materials import Maker

X86 = f"p270:32:32-p271:32:32-p272:64:64-i64:64-{'i128:128-' if QUADRANTS else ''}f80:128-n8:16:32:64-S128"
LAYOUTS = {
    "linux-x86_64": f"e-m:e-{X86}",
    "win32-amd64": f"e-m:w-{X86}",
    "darwin-x86_64": f"e-m:o-{X86}",
    "darwin-arm64": "e-m:o-i64:64-i128:128-n32:64-S128",
}
"""Data layouts of the platforms with wheels of Taichi; Quadrants' LLVM aligns i128, too."""

PLATFORM = f"{sys.platform}-{platform.machine().lower()}"


@functools.cache
def bitcode_file(device: str, precision: str, unit: Law | str, mixed: bool = False) -> str:
    """Return the path of a bitcode file; write the file if it does not exist.

    Args:
        device: ``cpu`` or ``cuda``.
        precision: ``f32`` or ``f64``.
        unit: A law, ``transfers`` or ``atomics``.
        mixed: Whether lanes of a tile may have different laws.

    Raises:
        plab.sim.DeviceError: If the file must be written and llvmlite cannot be loaded.
        plab.config.ConfigError: If a law contains operations that are not supported.
    """
    code = None
    digest = hashlib.sha256(repr((_sources(), LAYOUTS.get(PLATFORM), device, precision, mixed)).encode())
    if isinstance(unit, Law):
        try:
            digest.update(
                Path(inspect.getfile(unit.update)).read_bytes() + repr((unit.name, unit.size)).encode()
            )
        except (OSError, TypeError):
            # Typed into an interpreter: there is no file.
            code = _code(device, precision, unit, mixed)
            digest.update(code)
    name = f"{device}-{unit if isinstance(unit, str) else unit.name}-{precision}-{digest.hexdigest()[:12]}.bc"
    # RuntimeError: there is no home.
    for folder in (_cache, _temporary):
        with contextlib.suppress(OSError, RuntimeError):
            if (folder() / name).exists():
                return str(folder() / name)
    code = code or _code(device, precision, unit, mixed)
    for folder in (_cache, _temporary):
        with contextlib.suppress(OSError, RuntimeError):
            path = folder() / name
            path.parent.mkdir(parents=True, exist_ok=True)
            own = path.with_name(f"{name}.{os.getpid()}")
            own.write_bytes(code)
            own.replace(path)
            return str(path)
    raise _unsupported("plab found no folder to write its compiled laws to: set PLAB_CACHE_DIR")


def _cache() -> Path:
    return cache_dir() / "laws"


@functools.cache
def _temporary() -> Path:
    return Path(tempfile.mkdtemp(prefix="plab-laws-"))


@functools.cache
def _sources() -> bytes:
    """Return a digest of the bitcode sources: plab's own files and llvmlite."""
    folders = Path(__file__).parent, Path(laws.__file__).parent
    files = [path for folder in folders for path in sorted(folder.iterdir()) if path.suffix in (".py", ".ll")]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files))
    with contextlib.suppress(PackageNotFoundError):
        digest.update(version("llvmlite").encode())
    return digest.digest()


def _code(device: str, precision: str, unit: Law | str, mixed: bool) -> bytes:
    """Return the bitcode of a file as bytes."""
    if device == "cpu" and PLATFORM not in LAYOUTS:
        raise _unsupported(
            f"plab's simulator has no data layout for {PLATFORM}: it runs on {', '.join(LAYOUTS)}"
        )
    try:
        import llvmlite.binding as llvm
        from llvmlite import ir
    except ImportError as error:
        message = f"plab compiles its laws with llvmlite, which does not load ({error}): install it again"
        raise _unsupported(message) from None
    from plab.sim.codegen import materials, stencils

    if llvm.llvm_version_info[0] > 16 and not QUADRANTS:
        raise _unsupported(
            f"llvmlite {version('llvmlite')} is newer than Taichi: pip install 'llvmlite<0.45'"
        )
    if unit == "atomics":
        text = Path(__file__).with_name("cuda_global.ll").read_text(encoding="utf-8")
        if llvm.llvm_version_info[0] > 16:
            text = re.sub(r"(?:i32|i64|float|double)( addrspace\(1\))?\*", r"ptr\1", text)
        return bytes(llvm.parse_assembly(text).as_bitcode())
    makers: Mapping[str, Maker]
    if isinstance(unit, Law):
        makers = materials.law_makers(unit, device, mixed)
    else:
        makers = stencils.TILE_TRANSFERS if device == "cpu" else stencils.PARTICLE_TRANSFERS
    module = ir.Module("plab")
    module.data_layout = LAYOUTS[PLATFORM] if device == "cpu" else ""
    module.triple = "" if device == "cpu" else "nvptx64-nvidia-cuda"
    real = ir.FloatType() if precision == "f32" else ir.DoubleType()
    try:
        for name, make in makers.items():
            make(module, symbol(unit, name, precision), real)
    except Exception as error:
        # A law of the user may raise anything.
        if isinstance(unit, str):
            raise
        place = inspect.getsourcefile(unit.update)
        raise ConfigError(f"law {unit.name} of {place} cannot be compiled: {error}") from error
    parsed = llvm.parse_assembly(str(module).replace('target triple = ""\n', ""))
    parsed.verify()
    return bytes(parsed.as_bitcode())


def symbol(unit: Law | str, name: str, precision: str) -> str:
    """Return the name of a function in a file of bitcode."""
    return f"{unit if isinstance(unit, str) else unit.name}_{name}_{precision}"


def _unsupported(message: str) -> Exception:
    # Imported here, because it imports Taichi, which is not needed to write bitcode.
    from plab.sim.runtime import DeviceError

    return DeviceError(message)
