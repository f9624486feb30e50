"""Depth, segmentation and colour images of all environments of a simulator, rendered on its device.

Two passes per camera: one ray per pixel intersects the floor in closed form and manipulators by sphere
tracing; then each particle is drawn as a ball of the particle's volume. A pixel is one integer with depth in
the upper bits and label in the lower ones, so that an atomic minimum selects the nearest surface in any
order. Pictures are reproducible, independent of the batch.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from plab.plugins import torch
from plab.scenes import Camera
from plab.sim.compiler import ti
from plab.sim.tensors import Array, fill_tensor, on_device

if TYPE_CHECKING:
    from plab.sim.simulator import Simulator

BACKGROUND, FLOOR, FIRST_MANIPULATOR, FIRST_BODY = 0, 1, 2, 64
"""Segmentation labels; manipulators and bodies are numbered from the last two on."""

BALL_RADIUS = 0.7
"""Radius of a particle's ball [mean particle spacings], chosen such that depth is unbiased."""

TRACING_STEPS = 96
"""Maximum number of sphere-tracing steps per ray."""

PALETTE = [
    [246, 244, 240],
    [222, 218, 210],
    [120, 128, 140],
    [213, 94, 0],
    [0, 114, 178],
    [0, 158, 115],
    [204, 121, 167],
]
"""Colours of background, floor, manipulators and bodies [0 to 255]; bodies cycle through the last ones."""


@ti.data_oriented
class CameraSensor:
    """A camera in every environment of a simulator."""

    def __init__(self, simulator: "Simulator", camera: Camera) -> None:
        """Allocate the pictures.

        Args:
            simulator: The simulator; pictures show its current states.
            camera: The camera, the same for all environments.
        """
        self.camera = camera
        self._simulator, self.engine = simulator, simulator._engine
        self.batch, self.particles = simulator.batch, simulator.particle_count
        self.width, self.height = camera.size
        self.pixels = self.width * self.height
        self._keys = ti.ndarray(ti.i64, shape=self.batch * self.pixels)
        self._frame = ti.ndarray(ti.f32, shape=12)
        self._frame.from_numpy(np.concatenate([camera.position, *camera.axes()]).astype(np.float32))
        self._balls = ti.ndarray(ti.f32, shape=self.batch * self.particles)
        self._labels = ti.ndarray(ti.i32, shape=self.batch * self.particles)
        self.refresh()

    def refresh(self) -> None:
        """Update after the simulator's scenes have changed."""
        scenes = self._simulator.scenes
        bodies = [scene.particle_bodies for scene in scenes]
        spacings = [np.array([(b.volume / b.particles) ** (1 / 3) for b in scene.bodies]) for scene in scenes]
        balls = BALL_RADIUS * np.concatenate([own[b] for own, b in zip(spacings, bodies, strict=True)])
        labels = FIRST_BODY + np.concatenate(bodies)
        self._balls.from_numpy(balls.astype(np.float32))
        self._labels.from_numpy(labels.astype(np.int32))

    def capture(
        self, *names: str, like: "torch.Tensor | None" = None
    ) -> "dict[str, np.ndarray | torch.Tensor]":
        """Take pictures of the current states.

        Args:
            names: Out of ``depth``, ``segmentation`` and ``rgb``; default: all.
            like: Given a CUDA tensor, pictures are CUDA tensors and stay on the device.

        Returns:
            ``depth``: along the optical axis [domain units], ``camera.far`` for the background, shape [batch,
            height, width], float32. ``segmentation``: labels, see :data:`BACKGROUND`, same shape, int32.
            ``rgb``: shape [batch, height, width, 3], uint8.
        """
        self._simulator._require_runtime()
        particles, camera = self._simulator._particles, self.camera
        self._trace(self._frame, self._keys, camera.focal_length, camera.near, camera.far)
        arrays = particles.current, particles.numbers, self._frame, self._balls, self._labels, self._keys
        self._splat(*arrays, camera.focal_length, camera.near)
        out = {}
        for name in names or ("depth", "segmentation", "rgb"):
            depth = name == "depth"
            out[name] = self._filled(self._write, np.float32 if depth else np.int32, like, depth)
            if name == "rgb":
                light = self._filled(self._write_light, np.float32, like, self._frame, camera.focal_length)
                out[name] = _colours(out[name], light)
        return out

    def _filled(self, write: Any, kind: type, like: Any, *arguments: Any) -> Any:
        """Fill an image by a kernel; return an array, or a CUDA tensor like ``like``."""
        shape = self.batch, self.height, self.width
        if on_device(like):
            dtype = getattr(torch, kind.__name__)
            picture: Any = like.new_empty(shape, dtype=dtype)
            fill_tensor(picture, lambda out: write(self._keys, *arguments, out.reshape(-1)))
        else:
            picture = np.empty(shape, kind)
            write(self._keys, *arguments, picture.reshape(-1))
        return picture

    # -- kernels --------------------------------------------------------------------------------------

    @ti.func
    def key(self, depth, label):
        """Encode positive depth and label as an integer ordered by depth."""
        return (ti.cast(ti.bit_cast(ti.cast(depth, ti.f32), ti.i32), ti.i64) << 32) | ti.cast(label, ti.i64)

    @ti.func
    def depth_of(self, key):
        return ti.bit_cast(ti.cast(key >> 32, ti.i32), ti.f32)

    @ti.func
    def axis(self, frame: ti.template(), k: ti.template()):
        """Position (0) of the camera, and its right (1), up (2) and backward (3) axes."""
        return ti.Vector([frame[3 * k], frame[3 * k + 1], frame[3 * k + 2]])

    @ti.func
    def ray(self, frame: ti.template(), row, column, focal):
        """Direction of a pixel's ray, parametrised by depth."""
        right = (ti.cast(column, ti.f32) + 0.5 - 0.5 * self.width) / focal
        up = (0.5 * self.height - ti.cast(row, ti.f32) - 0.5) / focal
        return right * self.axis(frame, 1) + up * self.axis(frame, 2) - self.axis(frame, 3)

    @ti.kernel
    def _trace(self, frame: Array, keys: Array, focal: ti.f32, near: ti.f32, far: ti.f32):
        """Write the floor and the manipulators."""
        for q in range(self.batch * self.pixels):
            e, pixel = q // self.pixels, q % self.pixels
            origin = self.axis(frame, 0)
            ray = self.ray(frame, pixel // self.width, pixel % self.width, focal)
            length = ray.norm()
            best, label = far, BACKGROUND
            if ray[1] < 0.0 and origin[1] > 0.0:
                depth = -origin[1] / ray[1]
                if depth > near and depth < best:
                    best, label = depth, FLOOR
            for shape, start, stop in ti.static(self.engine.shape_ranges):
                for m in range(start, stop):
                    depth = near
                    for _step in range(TRACING_STEPS):
                        point = ti.cast(origin + depth * ray, self.engine.real)
                        distance = ti.cast(self.engine.end_distance(shape, e, m, point), ti.f32)
                        if distance < 2e-5:
                            best, label = depth, FIRST_MANIPULATOR + m
                            break
                        depth += distance / length
                        if depth >= best:
                            break
            keys[q] = self.key(best, label)

    @ti.kernel
    def _splat(
        self,
        state: Array,
        order: Array,
        frame: Array,
        balls: Array,
        labels: Array,
        keys: Array,
        focal: ti.f32,
        near: ti.f32,
    ):
        for q in range(self.engine.batch * self.engine.tiles * self.engine.lanes):
            e, place = self.engine.particle_of(q)
            if place < self.engine.particles:
                entry = self.engine.tile_entry(0, e, place // self.engine.lanes)
                own = ti.cast(self.engine.vector(state, entry, place % self.engine.lanes), ti.f32)
                number = e * self.engine.particles + order[q]
                radius, label = balls[number], labels[number]
                offset = own - self.axis(frame, 0)
                depth = -offset.dot(self.axis(frame, 3))
                if depth - radius > near:
                    across = offset.dot(self.axis(frame, 1)) / depth * focal + 0.5 * self.width
                    down = 0.5 * self.height - offset.dot(self.axis(frame, 2)) / depth * focal
                    # A ball's outline is an ellipse, longest away from the middle of the picture.
                    slant = offset.norm() / depth
                    reach = slant * radius / (depth - radius) * focal + 0.5
                    left = ti.max(0, ti.cast(ti.floor(across - reach), ti.i32))
                    right = ti.min(self.width - 1, ti.cast(ti.floor(across + reach), ti.i32))
                    top = ti.max(0, ti.cast(ti.floor(down - reach), ti.i32))
                    bottom = ti.min(self.height - 1, ti.cast(ti.floor(down + reach), ti.i32))
                    beyond = offset.dot(offset) - radius * radius
                    for row in range(top, bottom + 1):
                        for column in range(left, right + 1):
                            ray = self.ray(frame, row, column, focal)
                            along, square = ray.dot(offset), ray.dot(ray)
                            inside = along * along - square * beyond
                            if inside > 0.0:
                                hit = (along - ti.sqrt(inside)) / square
                                pixel = (e * self.height + row) * self.width + column
                                ti.atomic_min(keys[pixel], self.key(hit, label))

    @ti.kernel
    def _write(self, keys: Array, depth: ti.template(), out: Array):
        for q in range(self.batch * self.pixels):
            if ti.static(depth):
                out[q] = self.depth_of(keys[q])
            else:
                out[q] = ti.cast(keys[q] & 0xFFFF, ti.i32)

    @ti.func
    def point(self, keys: ti.template(), frame: ti.template(), e, row, column, focal):
        """Position of the surface at a pixel, relative to the camera."""
        depth = self.depth_of(keys[(e * self.height + row) * self.width + column])
        return depth * self.ray(frame, row, column, focal)

    @ti.func
    def slope(self, keys: ti.template(), frame: ti.template(), e, row, column, down: ti.template(), focal):
        """Difference in position between a pixel and its right or lower neighbour, or the opposite one if
        that is nearer in depth."""
        here = self.point(keys, frame, e, row, column, focal)
        across = ti.static(0 if down else 1)
        lower, right = ti.min(row + down, self.height - 1), ti.min(column + across, self.width - 1)
        after = self.point(keys, frame, e, lower, right, focal)
        before = self.point(keys, frame, e, ti.max(row - down, 0), ti.max(column - across, 0), focal)
        forward, backward = after - here, here - before
        use_backward = (backward.norm() < forward.norm() and backward.norm() > 0.0) or forward.norm() == 0.0
        return ti.select(use_backward, backward, forward)

    @ti.kernel
    def _write_light(self, keys: Array, frame: Array, focal: ti.f32, out: Array):
        """Shade manipulators and bodies by the angle between their surface and a light near the camera."""
        for q in range(self.batch * self.pixels):
            e, pixel = q // self.pixels, q % self.pixels
            row, column = pixel // self.width, pixel % self.width
            out[q] = 1.0
            if (keys[q] & 0xFFFF) >= FIRST_MANIPULATOR:
                along = self.slope(keys, frame, e, row, column, 0, focal)
                down = self.slope(keys, frame, e, row, column, 1, focal)
                normal = down.cross(along)
                lamp = self.axis(frame, 3) + 0.5 * self.axis(frame, 2) - 0.3 * self.axis(frame, 1)
                cosine = normal.dot(lamp) / ti.max(normal.norm() * lamp.norm(), 1e-20)
                out[q] = 0.35 + 0.65 * ti.max(cosine, 0.0)


def _colours(labels: Any, light: Any) -> Any:
    """Return label colours times light, shape [..., 3], uint8, as arrays or CUDA tensors."""
    bodies = len(PALETTE) - 3
    chosen = (labels >= FIRST_BODY) * (1 + (labels - FIRST_BODY) % bodies) + labels.clip(0, FIRST_MANIPULATOR)
    if not on_device(labels):
        return np.rint(np.array(PALETTE)[chosen] * light[..., None]).astype(np.uint8)
    return (light.new_tensor(PALETTE)[chosen] * light[..., None]).round().byte()
