"""Objective against direct formulas: loops over particles and nodes, one number at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from plab.config import build_scene, load_config
from plab.objective import (
    batch_scores,
    chamfer_distance,
    earth_movers_distance,
    earth_movers_distances,
    mass_change,
    score_scale,
    scores,
    scores_from_iou,
    soft_iou,
    spread_mass,
    target_entries,
    target_observation,
    target_sdf,
    total_loss,
)
from plab.scenes import sample_particles
from plab.targets import build_target

N = 8

positions = arrays(
    np.float64, st.tuples(st.integers(1, 5), st.just(3)), elements=st.floats(0.0, 1.0 - 3.0 / N)
)
tensors = arrays(np.float64, (3, 3, 3), elements=st.floats(0.0, 4.0)).filter(lambda a: a.max() > 1e-3)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def naive_kernel(distance: float) -> float:
    """Quadratic B-spline of a distance in cells."""
    d = abs(distance)
    if d < 0.5:
        return 0.75 - d * d
    return 0.5 * (1.5 - d) ** 2 if d < 1.5 else 0.0


def naive_mass(x: np.ndarray, n: int, mass: float) -> np.ndarray:
    """Mass tensor by visiting all nodes for each particle; ghost nodes below 0 are added to node 0."""
    grid = np.zeros((n, n, n))
    for p in x:
        for node in np.ndindex(n + 1, n + 1, n + 1):
            i, j, k = (index - 1 for index in node)
            w = naive_kernel(p[0] * n - i) * naive_kernel(p[1] * n - j) * naive_kernel(p[2] * n - k)
            grid[max(i, 0), max(j, 0), max(k, 0)] += mass * w
    return grid


@settings(max_examples=30, deadline=None)
@given(positions)
def test_spread_mass_is_the_b_spline_and_conserves_mass(x):
    mass = spread_mass(x, N, 0.25)
    np.testing.assert_allclose(mass, naive_mass(x, N, 0.25), atol=1e-14)
    assert mass.sum() == pytest.approx(0.25 * len(x), rel=1e-12) and mass.min() >= 0
    # At y = 0 the nodes -1, 0, 1 get 1/8, 3/4, 1/8; the ghost's share goes to node 0.
    column = spread_mass([[0.5, 0.0, 0.5]], N, 1.0).sum(axis=(0, 2))
    np.testing.assert_allclose(column, [0.875, 0.125] + [0.0] * (N - 2))


def test_target_sdf_is_the_distance_to_the_nearest_target_node(rng):
    mass = np.where(rng.random((N, N, N)) < 0.02, 1.0, 1e-4)
    nearest = np.linalg.norm(np.argwhere(mass > 0)[:, None] - np.argwhere(mass > 1e-4), axis=-1).min(axis=1)
    np.testing.assert_allclose(target_sdf(mass).ravel(), nearest / N, rtol=0, atol=1e-12)


@given(tensors, tensors)
def test_soft_iou_is_its_formula(a, b):
    p, q, iou = a / a.max(), b / b.max(), soft_iou(a, b)
    assert iou == pytest.approx((p * q).sum() / (p + q - p * q).sum(), rel=1e-9, abs=1e-12)
    assert 0 <= iou <= 1 + 1e-12 and soft_iou(b, a) == pytest.approx(iou, rel=1e-12)
    assert soft_iou(3 * a, 0.5 * b) == pytest.approx(iou, rel=1e-9)
    binary = np.zeros((3, 3, 3))
    binary[1, 1, :] = 0.7
    assert soft_iou(binary, binary) == 1.0 and soft_iou(binary, np.roll(binary, 1, axis=0)) == 0.0


def test_scores_are_their_formulas(rng):
    initial, final, target = (rng.random((4, 4, 4)) ** power for power in (6.0, 2.0, 3.0))
    s = scores(initial, final, target)
    start, end, best = soft_iou(initial, target), soft_iou(final, target), soft_iou(target, target)
    assert (s.iou_initial, s.iou_final, s.iou_target_self) == (start, end, best)
    assert s.score_printed == pytest.approx((end - start) / (1 - start))
    assert s.score == pytest.approx(min(max((end - start) / (best - start), 0), 1))
    assert 0 < s.score_printed < s.score
    # Worse than the start: clamped, while the printed formula goes below 0.
    worse = np.where(target == target.min(), 1.0, 0.0)
    s = scores(initial, worse, target)
    assert s.score == 0.0 > s.score_printed and scores(initial, target, target).score == 1.0


def box_of_mass(low, high, n=32):
    mass = np.zeros((n, n, n))
    mass[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = 1.0
    return mass


def test_target_observation():
    """Disjoint boxes require moving all mass; for half a box, half of the mass may stay."""
    start, target = box_of_mass((4, 6, 8), (8, 12, 16)), 3.0 * box_of_mass((20, 8, 18), (26, 12, 22))
    seen = target_observation(start, target, 1)
    assert seen.shape == (target_entries(1),)
    corners = zip(seen.reshape(2, 7), ((4, 6, 8), (20, 8, 18)), ((8, 12, 16), (26, 12, 22)), strict=True)
    for (share, *numbers), low, high in corners:
        width = np.subtract(high, low)
        assert share == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(numbers[:3], (np.array(low) + (width - 1) / 2) / 32, atol=1e-9)
        # Of uniform nodes, and of the Gaussian, cut off at four deviations.
        np.testing.assert_allclose(numbers[3:], np.sqrt((width**2 - 1) / 12 + 1.0) / 32, rtol=1e-3)
    start, target = box_of_mass((8, 8, 8), (16, 16, 16)), box_of_mass((12, 8, 8), (20, 16, 16))
    go, come = target_observation(start, target, 1).reshape(2, 7)
    assert go[0] == come[0] == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose((go[1] * 32, come[1] * 32), (9.5, 17.5), atol=0.3)
    np.testing.assert_allclose((go[2:4], come[2:4]), 11.5 / 32, atol=1e-9)
    assert mass_change(start, target)[17, 11, 11] > 0 > mass_change(start, target)[9, 11, 11]
    assert not target_observation(start, start, 2).any()
    # Four parts of equal mass, dividing the plane x = 15.
    start, target = box_of_mass((0, 0, 0), (4, 4, 4)), box_of_mass((13, 8, 16), (18, 12, 24))
    parts = target_observation(start, target, 2)[target_entries(2) // 2 + 1 :]
    x, _, z = parts.reshape(4, 6).T[:3] * 32
    np.testing.assert_allclose((x, z), ([13.75] * 2 + [16.25] * 2, [17.5, 21.5] * 2), atol=0.2)


def test_total_loss(rng):
    weights = np.array([10.0, 5.0, 2.0])
    steps = rng.random((2, 6, 3))
    loss = total_loss(steps, weights)
    assert loss.shape == (2, 6)
    for b, t in np.ndindex(2, 6):
        d, s, c = steps[b, t]
        assert loss[b, t] == pytest.approx(10 * d + 5 * s + 2 * c)


@pytest.mark.parametrize("x", [[1.0 - 1.0 / N, 0.5, 0.5], [0.5, -1.0 / N, 0.5]])
def test_particles_outside_the_grid_are_refused(x):
    with pytest.raises(ValueError, match="outside the grid"):
        spread_mass([x], N, 1.0)


def test_scores_where_nothing_can_be_gained_and_beyond_the_target():
    full = np.zeros((3, 3, 3))
    full[1] = 1.0
    stayed, left = scores(full, full, full), scores(full, np.roll(full, 1, axis=0), full)
    assert (stayed.score, stayed.score_printed, left.score, left.score_printed) == (1.0, 1.0, 0.0, 0.0)
    assert scores_from_iou(0.5, 0.45, 0.4).score == 1.0 and scores_from_iou(0.5, 0.35, 0.4).score == 0.0
    np.testing.assert_array_equal(batch_scores(score_scale([0.2], [0.5]), np.array([0.6]))[0], [1.0])


def test_mass_at_a_wall_is_smoothed_into_the_void():
    start, target = np.zeros((2, 32, 32, 32))
    start[0, 0, 0] = target[16, 16, 16] = 1.0
    change = mass_change(start, target)
    assert change.clip(0.0).sum() == pytest.approx(1.0, abs=1e-3) and (-change).clip(0.0).sum() < 0.5


def test_distances_of_shapes_are_the_way_between_them():
    rng, (a, b) = np.random.default_rng(0), np.zeros((2, 32, 32, 32))
    a[4:8, 4:8, 4:8] = rng.random((4, 4, 4)) + 0.1
    b[20:24, 4:8, 4:8] = a[4:8, 4:8, 4:8]
    assert earth_movers_distance(a, a) == chamfer_distance(a, a) == 0.0
    # A shift that keeps the order of the nodes.
    assert earth_movers_distance(a, 3.0 * b) == pytest.approx(16 / 32, abs=1e-9)
    nearest = np.average(20 - np.arange(4, 8), weights=a[4:8].sum((1, 2)))
    farthest = np.average(np.arange(20, 24) - 7, weights=a[4:8].sum((1, 2)))
    assert chamfer_distance(a, b) == pytest.approx((nearest + farthest) / 32)
    # In other proportions: a tenth of the mass has to cross.
    assert earth_movers_distance(a / a.sum() + b / b.sum(), a / a.sum() * 1.2 + 0.8 * b / b.sum()) == (
        pytest.approx(0.1 * 16 / 32, rel=0.05)
    )


def test_distances_of_a_batch_are_close_to_the_exact_ones() -> None:
    cfgs = [load_config([f"task={task}"]) for task in ("Move", "Rope", "TripleMove")]
    scenes, like = [build_scene(cfg) for cfg in cfgs], torch.empty(0)
    starts = [spread_mass(sample_particles(one), one.grid_size, one.particle_mass) for one in scenes]
    targets = [build_target(one, cfg.task.target) for one, cfg in zip(scenes, cfgs, strict=True)]
    exact = np.array([earth_movers_distance(*pair) for pair in zip(starts, targets, strict=True)])
    bound = earth_movers_distances(starts, targets, like)
    assert bound.dtype == torch.float64 and (bound.numpy() <= exact).all()
    np.testing.assert_allclose(bound, exact, atol=0.002)
    assert earth_movers_distances(starts[:1], targets[:1], like) == bound[0]
    assert not earth_movers_distances(starts, starts, like).any()
    # The distance of translated copies is the translation.
    moved = earth_movers_distances(starts, np.roll(starts, (3, 2), axis=(1, 3)), like)
    np.testing.assert_allclose(moved, np.hypot(3, 2) / 64, atol=0.006)
