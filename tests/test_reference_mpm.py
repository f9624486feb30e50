"""Reference implementation against hand-computed values."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import reference_mpm as ref
from plab.scenes import Body, Scene

torch.set_num_threads(1)

IDENTITY = torch.eye(3, dtype=torch.float64)


def make_scene(**changes: object) -> Scene:
    """Block of 40 particles in mid-air on a coarse grid."""
    body = Body("box", (0.5, 0.5, 0.5), (0.25, 0.2, 0.25), 40)
    return replace(Scene("test", (body,), (), grid_size=16, dt=4e-4, substeps=3), **changes)


def random_matrices(shape: tuple[int, ...], scale: float, seed: int = 0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_stress_is_the_derivative_of_the_fixed_corotated_energy() -> None:
    scene = make_scene()
    F = (IDENTITY + random_matrices((4, 3, 3), 0.1)).requires_grad_()
    strain_energy = scene.material.lame[0] * ((torch.linalg.svdvals(F) - 1.0) ** 2).sum()
    volume_energy = scene.material.lame[1] / 2.0 * ((torch.linalg.det(F) - 1.0) ** 2).sum()
    (P,) = torch.autograd.grad(strain_energy + volume_energy, F)
    U, _, Vt = ref.proper_svd(F)
    torch.testing.assert_close(ref.kirchhoff_stress(scene, F, U @ Vt), P @ F.mT, rtol=1e-10, atol=1e-9)


def test_hard_and_soft_contact_by_hand() -> None:
    v = torch.tensor([[3.0, -2.0, 4.0]], dtype=torch.float64)
    u = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    up = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)

    def at(distance: float, friction: float, alpha: float) -> list[float]:
        d = torch.tensor([distance], dtype=torch.float64)
        return ref.contact(v, u, d, up, friction, alpha)[0].tolist()

    # r = (3, -3, 4), |t| = 5, r_n = -3
    assert at(0.0, 0.0, 0.0) == pytest.approx([3.0, 1.0, 4.0])
    assert at(-0.1, 0.5, 0.0) == pytest.approx([3.0 * 0.7, 1.0, 4.0 * 0.7])
    assert at(-0.1, 2.0, 0.0) == pytest.approx([0.0, 1.0, 0.0]) and at(1e-9, 2.0, 0.0) == v[0].tolist()
    s = math.exp(-1.0)
    assert at(0.01, 0.5, 100.0) == pytest.approx(
        [3.0 * (1 - s) + 2.1 * s, 1.0 - 3.0 * (1 - s), 4.0 * (1 - s) + 2.8 * s]
    )
    assert at(-5.0, 0.5, 666.0) == at(-0.1, 0.5, 0.0)
    assert at(math.log(10.0) / 100.0 + 1e-9, 0.5, 100.0) == v[0].tolist()
    leaving = ref.contact(v, u, torch.zeros(1, dtype=torch.float64), -up, 5.0, 0.0)
    assert leaving[0].tolist() == pytest.approx(v[0].tolist())


def test_floor_and_walls_by_hand() -> None:
    node = torch.tensor([[8, 2, 8], [8, 3, 8], [-1, -1, 14], [8, 2, 8], [14, 14, 13], [8, 2, 8]])
    v = torch.tensor(
        [[3, -1, 4], [3, -1, 4], [-3, -1, 4], [3, 1, 4], [3, 1, 4], [0, -1, 0]], dtype=torch.float64
    )

    def after(friction: float) -> Tensor:
        return ref.walls(make_scene(floor_friction=friction), node, v)

    untouched = {1: [3, -1, 4], 3: [3, 1, 4], 4: [0, 0, 4]}
    for friction, sliding in ((0.0, [3, 0, 4]), (2.0, [1.8, 0, 2.4]), (9.0, [0, 0, 0]), (10.0, [0, 0, 0])):
        result = after(friction)
        rows = {0: sliding, 2: [0, 0, 0], 5: [0, 0, 0], **untouched}
        for row, expected in rows.items():
            assert result[row].tolist() == pytest.approx(expected, abs=1e-14), (friction, row)
