"""What plab does differently from PlasticineLab's release on purpose, and how much it matters.

    python -m plab.bench.release --csv release.csv
    python -m plab.bench.release --task Move,Rope --particles 10000

Two choices of the release are put into the simulator, one at a time, in float64; both floors are of the
scene, see :class:`plab.scene.Scene`:

- ``floor``: base nodes are truncated toward zero, so that particles within half a cell of the domain's lower
  faces have negative weights. Compared are the final state and score of a demonstration in the hard contact
  model.
- ``svd``: the gradient goes through the singular value decomposition, with ``s_i^2 - s_j^2`` clamped to at
  least 1e-6 in size. Compared is the gradient in the soft contact model at random actions of 1e-4, where F is
  close to the identity, and at 0.7 times a demonstration.

The target is what the demonstration ends with in plab. All tasks share a compiled simulator, see
:mod:`plab.bench.common_scene`; the loss has no contact term.
"""

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import taichi as ti

from plab.bench.common_scene import grid_terms
from plab.bench.precision import Start, angle, mass_of, starts
from plab.objective import TARGET_MASS, scores, target_sdf
from plab.scene import sample_particles
from plab.sim import Simulator, Skips, particle_phases
from plab.sim.spectral import SINGULAR_VALUE_MIN, mapped_values, svd_signed

__all__ = ["CHOICES", "COLUMNS", "rows"]

COLUMNS = ("choice", "task", "actions", "score", "score_release", "positions_rms", "norm_ratio", "angle_deg")

CLAMP = 1e-6
"""Least size of ``s_i^2 - s_j^2`` in the release's gradient."""

SMALL, LARGE = 1e-4, 0.7
"""Size of random actions, and factor on a demonstration's, at which gradients are compared."""


@ti.func
def clamped(sa, sb):
    """``sb^2 - sa^2``, at least :data:`CLAMP` in size."""
    d = sb * sb - sa * sa
    return ti.select(d >= 0.0, ti.max(d, CLAMP), ti.min(d, -CLAMP))


@ti.func
def clamped_adjoint(f_trial, f_new_bar, tau_bar, mu, lam, yield_strain, tiny):
    """:func:`plab.sim.spectral.spectral_return_map_adjoint` through the factors U, S and V, as the release
    has it: everything that depends on two singular values is divided by :func:`clamped`."""
    u, s, v = svd_signed(f_trial)
    g, _t, e, k, n = mapped_values(s, mu, lam, yield_strain)
    p = u.transpose() @ f_new_bar @ v
    q = u.transpose() @ tau_bar @ u
    trace_q = q[0, 0] + q[1, 1] + q[2, 2]
    j = g[0] * g[1] * g[2]
    mean = (e[0] + e[1] + e[2]) / 3.0
    dev = e - mean
    log_bar = s * 0.0
    x = f_trial * 0.0
    for i in ti.static(range(3)):
        g_bar = p[i, i] + 2.0 * mu * (2.0 * g[i] - 1.0) * q[i, i]
        log_bar[i] = g_bar * g[i] + lam * (2.0 * j - 1.0) * j * trace_q
    mean_bar = (log_bar[0] + log_bar[1] + log_bar[2]) / 3.0
    k_bar = log_bar.dot(dev)
    for i in ti.static(range(3)):
        e_bar = log_bar[i]
        if k < 1.0:
            e_bar = mean_bar + k * (log_bar[i] - mean_bar) - k_bar * k * dev[i] / (n * n)
        if k >= 1.0 or s[i] > SINGULAR_VALUE_MIN:
            x[i, i] = e_bar / s[i]
    for a, b in ti.static(((0, 1), (0, 2), (1, 2))):
        c = clamped(s[a], s[b])
        slope = (g[b] - g[a]) * (s[a] + s[b]) / c
        turn = (g[a] + g[b]) * (s[b] - s[a]) / c
        if k >= 1.0:
            # Without yielding the new F is the trial F itself, not a product of its factors.
            slope = 1.0 + 0.0 * slope
            turn = 1.0 + 0.0 * turn
        t = 2.0 * mu * (g[a] + g[b] - 1.0) * (g[b] - g[a]) / c
        sym = 0.5 * (p[a, b] + p[b, a]) * slope + q[a, b] * t * (s[a] + s[b])
        skew = 0.5 * (p[a, b] - p[b, a]) * turn + q[a, b] * t * (s[b] - s[a])
        x[a, b] = sym + skew
        x[b, a] = sym - skew
    return u @ x @ v.transpose()


CHOICES = ("floor", "svd")
"""The release's choices that can be measured."""


@contextlib.contextmanager
def decomposed() -> Iterator[None]:
    """Put the release's gradient into simulators that are compiled meanwhile."""
    ours = particle_phases.spectral_return_map_adjoint
    particle_phases.spectral_return_map_adjoint = clamped_adjoint
    try:
        yield
    finally:
        particle_phases.spectral_return_map_adjoint = ours


def rows(tasks: Sequence[str], particles: int, choices: Sequence[str]) -> Iterator[dict[str, object]]:
    """Compare the release's choices with plab's.

    Args:
        tasks: Tasks, of which the first variants are taken.
        particles: Particles per environment.
        choices: Some of :data:`CHOICES`.

    Yields:
        A row of :data:`COLUMNS` per choice and task, and kind of actions where gradients are compared.
    """
    configurations = starts(tasks, ["1"], particles)
    for name in choices:
        if name == "floor":
            truncated = [replace(s, scene=replace(s.scene, floor="release")) for s in configurations]
            ours, theirs = _states(configurations), _states(truncated)
        else:
            ours = _gradients(configurations)
            with decomposed():
                theirs = _gradients(configurations)
        for start in configurations:
            for row in ours[start.task]:
                yield {"choice": name, "task": start.task} | _row(
                    start, row, ours[start.task][row], theirs[start.task][row]
                )


def _simulator(configurations: Sequence[Start], *, series: bool) -> Simulator:
    skips = Skips(singular_values=series)
    return Simulator([configurations[0].scene], terms=grid_terms(), precision="float64", skips=skips)


def _states(configurations: Sequence[Start]) -> Mapping[str, Mapping[str, np.ndarray]]:
    """Final positions of the demonstrations, NaN where they break off, by task and kind of actions."""
    simulator = _simulator(configurations, series=True)
    simulator.set_contact("hard")
    out = {}
    for start in configurations:
        simulator.set_scenes([start.scene])
        shown = start.actions["demonstration"][None]
        failures = simulator.rollout(shown, gradient=False, strict=False).failures
        out[start.task] = {"demonstration": simulator.state().x[0] + (np.nan if failures else 0.0)}
    return out


def _gradients(configurations: Sequence[Start]) -> Mapping[str, Mapping[str, np.ndarray]]:
    """Gradients at small and at large actions, by task and kind of actions."""
    simulator = _simulator(configurations, series=False)
    out = {}
    for number, start in enumerate(configurations):
        shown = start.actions["demonstration"]
        simulator.set_scenes([start.scene])
        simulator.set_contact("hard")
        simulator.rollout(shown[None], gradient=False)
        target = mass_of(start.scene, simulator.state().x[0])
        threshold = TARGET_MASS * start.scene.particle_count / start.particles
        simulator.set_target(target[None], target_sdf(target, threshold)[None])
        simulator.set_contact("soft")
        small = np.random.default_rng(number).uniform(-SMALL, SMALL, size=shown.shape)
        tried = {f"random, {SMALL:g}": small, f"demonstration, {LARGE:g}": LARGE * shown}
        out[start.task] = {
            kind: cast(np.ndarray, simulator.rollout(actions[None]).gradient)[0][:, start.components]
            for kind, actions in tried.items()
        }
    return out


def _row(start: Start, kind: str, ours: np.ndarray, theirs: np.ndarray) -> dict[str, object]:
    """Compare final positions, or gradients."""
    row: dict[str, object] = {"actions": kind, **dict.fromkeys(COLUMNS[3:], "")}
    if kind != "demonstration" and not np.any(ours):
        return row | {"norm_ratio": "no gradient"}
    if kind != "demonstration":
        ratio = np.linalg.norm(theirs) / np.linalg.norm(ours)
        return row | {"norm_ratio": f"{ratio:.4f}", "angle_deg": f"{angle(theirs, ours):.3g}"}
    if not np.isfinite(theirs).all():
        return row | {"score_release": "breaks off"}
    initial, target = mass_of(start.scene, sample_particles(start.scene)), mass_of(start.scene, ours)
    for column, x in (("score", ours), ("score_release", theirs)):
        row[column] = f"{scores(initial, mass_of(start.scene, x), target).score:.4f}"
    row["positions_rms"] = f"{np.sqrt(((ours - theirs) ** 2).sum(axis=1).mean()):.2e}"
    return row


if __name__ == "__main__":
    from plab.cli.bench import release

    sys.exit(release())
