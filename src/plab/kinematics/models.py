"""Reader of articulated models in MJCF and URDF files, with the `mujoco` package."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from plab.files import find_file
from plab.kinematics.chain import Chain, Joint, Link, ModelError, matched, pose_matrix

CAPSULE_RATIO = 1.5
"""Largest ratio of the shorter edges of a mesh's oriented bounding box for fitting a capsule; otherwise the
box is used."""

# Quaternions from the frame of a shape about y to that of a geom about x, y or z.
_ALONG = ((0.5**0.5, 0.0, 0.0, -(0.5**0.5)), (1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.5**0.5, 0.0, 0.0))


def read_model(
    model: str, root: str | None = None, size: float = 1.0, omit: Sequence[str] = ()
) -> tuple[Chain, str]:
    """Read the tree below a body of a model: hinges and slides as joints, collision geometry as links.

    Capsules, boxes, spheres and cylinders are used directly; meshes are replaced by a capsule or box of the
    size of their oriented bounding box. Visual geometry, planes and free joints are left out. Models are
    cached until the file itself changes.

    Args:
        model: MJCF or URDF file, or ``package:path`` of a file in an installed package.
        root: Body whose frame becomes the model frame; default: the model's world frame.
        size: Domain units per unit of length of the model.
        omit: Patterns of names of omitted geometry.

    Returns:
        The tree with joints at the model's rest position, the model's limits, and scale 0; and the SHA-256 of
        all its numbers.

    Raises:
        ModelError: If `mujoco`, the file or the body is missing, a feature is not supported, or a pattern
            matches nothing.
    """
    package, colon, inside = model.partition(":")
    path = model
    if colon and not os.path.exists(model):
        spec = find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            raise ModelError(f"{model}: package {package} is not installed: pip install 'plab[hands]'")
        path = os.path.join(spec.submodule_search_locations[0], inside)
    if not os.path.isfile(path):
        raise ModelError(f"there is no model {path}")
    chain = _read(path, os.stat(path).st_mtime_ns, root, size, tuple(omit))
    return chain, hashlib.sha256(repr(chain).encode()).hexdigest()


def locate_model(model: str, *, by_name: bool) -> str:
    """Return the path of a model file, see :func:`plab.files.find_file`, unless it is in a package."""
    inside_package = ":" in model and not os.path.exists(model)
    return model if inside_package else str(find_file(model, by_name=by_name))


@functools.lru_cache(maxsize=32)
def _read(path: str, _changed: int, root: str | None, size: float, omit: tuple[str, ...]) -> Chain:
    try:
        import mujoco
    except ImportError:
        raise ModelError(f"{path} is read with mujoco: pip install 'plab[hands]'") from None
    try:
        m = mujoco.MjModel.from_xml_path(path)
    except ValueError as error:
        raise ModelError(f"{path}: {str(error).splitlines()[0]}") from None
    first = 0 if root is None else mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, root)
    if first < 0:
        names = ", ".join(m.body(k).name for k in range(1, m.nbody))
        raise ModelError(f"{path} has no body '{root}'; choose from: {names}")
    joints: list[Joint] = []
    # For each body: parent joint, and transform to its frame.
    frames: dict[int, tuple[int, np.ndarray]] = {first: (-1, np.eye(4))}
    for body in range(first, m.nbody):
        if body != first:
            if m.body_parentid[body] not in frames:
                continue
            parent, above = frames[m.body_parentid[body]]
            frames[body] = parent, above @ pose_matrix(size * m.body_pos[body], m.body_quat[body])
        for k in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
            name, kind = m.joint(k).name or f"joint{k}", m.jnt_type[k]
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                continue
            if kind == mujoco.mjtJoint.mjJNT_BALL:
                raise ModelError(f"{path}: joint {name} is a ball joint: use three hinges")
            hinge, rest = bool(kind == mujoco.mjtJoint.mjJNT_HINGE), m.qpos0[m.jnt_qposadr[k]]
            unit = 1.0 if hinge else size
            low, high = unit * (m.jnt_range[k] - rest) if m.jnt_limited[k] else (-np.inf, np.inf)
            parent, offset = frames[body]
            axis, anchor = _rounded(m.jnt_axis[k]), _rounded(size * m.jnt_pos[k])
            joints.append(Joint(name, parent, _rounded(offset), hinge, axis, anchor, float(low), float(high)))
            frames[body] = len(joints) - 1, np.eye(4)
    geoms = [
        g
        for g in range(m.ngeom)
        if m.geom_bodyid[g] in frames
        and (m.geom_contype[g] or m.geom_conaffinity[g])
        and m.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE
    ]
    names = [m.geom(g).name or f"geom{g}" for g in geoms]
    left_out = matched("omit", dict.fromkeys(omit, True), names)
    links = []
    for g, name in zip(geoms, names, strict=True):
        if name in left_out:
            continue
        parent, frame = frames[m.geom_bodyid[g]]
        own = frame @ pose_matrix(size * m.geom_pos[g], m.geom_quat[g])
        kind = mujoco.mjtGeom(m.geom_type[g]).name.removeprefix("mjGEOM_")
        shape, lengths, inside = _shape(kind, size * m.geom_size[g], size * m.geom_aabb[g])
        if shape is None:
            raise ModelError(f"{path}: {name} is of type {kind.lower()}: use a capsule, box, sphere or mesh")
        links.append(Link(parent, _rounded(own @ inside), f"{shape}Link", tuple(_rounded(lengths))))
    # Links of the same shape share a compiled loop.
    links.sort(key=lambda link: link.shape)
    if not links:
        raise ModelError(f"{path}: nothing below {root or 'the world'} has collision geometry")
    return Chain(tuple(joints), tuple(links))


def _shape(kind: str, lengths: np.ndarray, box: np.ndarray) -> tuple[str | None, Any, np.ndarray]:
    """Return a link's shape, its lengths, and the transform from its frame to the geom's, given the geom's
    MuJoCo type, lengths [3] and bounding box: centre and half edges [6]."""
    radius, half = lengths[:2]
    upright = pose_matrix((0.0, 0.0, 0.0), _ALONG[2])
    if kind == "SPHERE":
        return "Sphere", [radius], np.eye(4)
    if kind == "CAPSULE":
        return "Capsule", [2.0 * half, radius], upright
    if kind == "CYLINDER":
        return "Cylinder", [radius, half], upright
    if kind == "BOX":
        return "Box", lengths, np.eye(4)
    if kind != "MESH":
        return None, [], upright
    edges, longest = box[3:], int(np.argmax(box[3:]))
    small, middle = np.sort(edges)[:2]
    if middle > CAPSULE_RATIO * small:
        return "Box", edges, pose_matrix(box[:3], _ALONG[1])
    thick = 0.5 * (small + middle)
    length = max(2.0 * (edges[longest] - thick), 1e-6)
    return "Capsule", [length, thick], pose_matrix(box[:3], _ALONG[longest])


def _rounded(values: Any) -> Any:
    """Numbers as tuples, to 12 decimals, because the last bits vary between versions of MuJoCo."""
    rounded = (np.round(np.asarray(values, float), 12) + 0.0).tolist()
    return tuple(map(tuple, rounded)) if np.ndim(values) == 2 else tuple(rounded)
