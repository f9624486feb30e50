"""Scenes: bodies, materials, meshes, manipulators, cameras and particle sampling."""

from plab.scenes import scene
from plab.scenes.camera import Camera
from plab.scenes.scene import *  # noqa: F403

__all__ = ["Camera", *scene.__all__]
