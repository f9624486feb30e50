"""A star as a mesh, a point cloud and a mass tensor: the files of docs/own_shapes.md."""

import numpy as np

from plab.objective import spread_mass

CORNERS, HEIGHT = 60, 0.07


def radius(angle):
    """Distance of the star's edge from its axis."""
    return 0.1 + 0.03 * np.cos(5 * angle)


# Below and above, the axis and then the edge; triangles are counter-clockwise seen from outside.
angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
edge = [(0, 0), *zip(radius(angle) * np.cos(angle), radius(angle) * np.sin(angle), strict=True)]
vertices = [(x, y, z) for y in (0, HEIGHT) for x, z in edge]
faces = []
for k in range(1, CORNERS + 1):
    after, above, above_after = k % CORNERS + 1, k + CORNERS + 1, k % CORNERS + CORNERS + 2
    faces += [(0, k, after), (CORNERS + 1, above_after, above)]
    faces += [(k, above, above_after), (k, above_after, after)]
with open("star.obj", "w") as file:
    file.writelines(f"v {x:.5f} {y:.5f} {z:.5f}\n" for x, y, z in vertices)
    file.writelines(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)

# Points that fill the star, pressed together along x and wider along z, on the floor.
x, y, z = np.random.default_rng(0).uniform(-0.13, 0.13, (3, 60000))
inside = (np.hypot(x, z) < radius(np.arctan2(z, x))) & (np.abs(y) < HEIGHT / 2)
cloud = np.stack([0.52 + 0.9 * x, HEIGHT / 2 + y, 0.5 + z / 0.9], axis=1)[inside]
np.save("cloud.npy", cloud)

# The same on a grid of 32 nodes per axis, that of sim=coarse; its mass is whatever it is.
np.save("mass.npy", spread_mass(cloud, n=32, mass=1.0))
