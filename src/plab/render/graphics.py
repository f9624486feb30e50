"""Requirements of rendering: packages and off-screen OpenGL."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections.abc import Mapping
from importlib.util import find_spec

from plab.errors import PlabError

_WINDOW = "VTK_DEFAULT_OPENGL_WINDOW"


class RenderError(PlabError, RuntimeError):
    """Picture that cannot be drawn or written; the one-line message states the reason and the remedy."""


def require_graphics() -> None:
    """Raise :class:`RenderError` if a requirement of rendering is missing."""
    if reason := missing_graphics():
        raise RenderError(reason)


def require_packages(who_needs: str, packages: Mapping[str, str], extra: str) -> None:
    """Raise :class:`RenderError` if a package, given by module and display name, is missing; the message
    begins with ``who_needs``, and names the ``extra`` that installs the package."""
    for package, name in packages.items():
        if find_spec(package) is None:
            raise RenderError(f"{who_needs} {name}, which is not installed: pip install 'plab[{extra}]'")


@functools.cache
def missing_graphics() -> str | None:
    """Return the missing requirements of rendering and how to install them, or None.

    On Linux, VTK renders through EGL, which needs no screen, unless the environment variable
    ``VTK_DEFAULT_OPENGL_WINDOW`` is set.
    """
    try:
        require_packages("pictures need", {"pyvista": "PyVista", "PIL": "Pillow"}, "render")
    except RenderError as error:
        return str(error)
    if sys.platform.startswith("linux") and _WINDOW not in os.environ:
        if not _egl_works():
            return (
                "pictures need OpenGL through EGL, which does not work here; on Debian and Ubuntu: "
                "apt-get install libegl1 libgl1-mesa-dri"
            )
        os.environ[_WINDOW] = "vtkEGLRenderWindow"
    return None


def _egl_works() -> bool:
    """Return whether EGL has a device, which may be the software renderer."""
    try:
        # Without it VTK would end the process with a segmentation fault.
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkRenderingOpenGL2 import vtkEGLRenderWindow

    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    count = vtkEGLRenderWindow().GetNumberOfDevices()
    vtkLogger.SetStderrVerbosity(verbosity)
    return count > 0
