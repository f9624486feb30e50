"""Scenes: bodies, materials, meshes, manipulators, and the particles sampled from them."""

from plab.scenes.scene import *  # noqa: F403
from plab.scenes.scene import __all__  # noqa: F401
