"""Libraries that take long to import, and are imported when they are first used."""

from typing import TYPE_CHECKING

from plab.plugins import LazyModule

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

__all__ = ["torch"]
