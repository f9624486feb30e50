"""What each of the simulator's skips saves: the same rollout with one of them switched off.

Both simulators are there at once and take turns, so that whatever else the machine does hits both.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from plab.bench.workload import FORWARD, GRADIENT, REWARD, WARM_UP, Workload, build
from plab.config import ConfigError, load_config
from plab.errors import pick
from plab.progress import show_line
from plab.sim import Skips

__all__ = ["CASES", "COLUMNS", "SkipCase", "cases_for", "rows"]

COLUMNS = (
    "skip", "task", "device", "precision", "batch", "what", "ms", "ms_without", "ratio", "ratio_min",
    "ratio_max", "loss_difference", "gradient_difference", "equal",
)  # fmt: skip

TOLERANCE = {"float32": 2e-3, "float64": 1e-9}
"""Largest difference of losses and gradients, relative to the largest component. Rounding grows along a
rollout, because plasticity and contact have kinks."""


@dataclass(frozen=True)
class SkipCase:
    """A skip, and a scene that has something to skip.

    Attributes:
        skip: Field of :class:`plab.sim.Skips`.
        overrides: The scene.
        kinds: What is timed, the most telling first.
        devices: Devices on which the skip exists.
        from_start: Start at the scene's start, not in the middle of its demonstration.
    """

    skip: str
    overrides: tuple[str, ...]
    kinds: tuple[str, ...] = (FORWARD, GRADIENT)
    devices: tuple[str, ...] = ("cpu", "cuda")
    from_start: bool = False


CASES = (
    SkipCase("empty_blocks", ("task=Move",)),
    SkipCase("empty_grids", ("task=Move",), devices=("cpu",)),
    SkipCase("far_manipulators", ("task=TripleMove",), (GRADIENT, FORWARD)),
    SkipCase("rotations", ("task=TripleMove",), (GRADIENT, FORWARD)),
    SkipCase("singular_values", ("task=Move",)),
    SkipCase("flow", ("task=Move",)),
    SkipCase("history", ("task=Move",), (REWARD,)),
    SkipCase("still_manipulators", ("task=Rope",), (GRADIENT, REWARD)),
    SkipCase("adjoints", ("task=Torus",), (GRADIENT,), from_start=True),
    SkipCase("launches", ("task=Move",), (FORWARD, GRADIENT), devices=("cuda",)),
    SkipCase("waiting", ("task=Move",), devices=("cpu",)),
)
"""A row of the table each, for every kind."""


def cases_for(device: str, names: Sequence[str] | None) -> list[SkipCase]:
    """Return the cases of a device, all or those of some skips.

    Raises:
        plab.config.ConfigError: If a skip does not exist on the device.
    """
    cases = [case for case in CASES if device in case.devices]
    known = [case.skip for case in cases]
    for name in names or ():
        if name not in known:
            raise ConfigError(f"--skips: on {device} there is no '{name}'; {pick(name, known)}")
    return [case for case in cases if not names or case.skip in names]


def rows(
    cases: Sequence[SkipCase],
    overrides: Sequence[str],
    batch: int,
    steps: int,
    repeats: int,
    quick: bool,
    refused: list[str],
) -> Iterator[dict[str, object]]:
    """Measure skips.

    Args:
        cases: Which.
        overrides: Configuration overrides, after those of the case.
        batch: Number of environments.
        steps: Environment steps per rollout; a whole episode where a case starts at the scene's start.
        repeats: Timed pairs of rollouts.
        quick: Only the first kind of each case.
        refused: Where a case needs more memory than the budget, a line is added here; the others go on.

    Yields:
        A row per case and kind; ``ratio`` is the time without the skip over the time with it.
    """
    for case in cases:
        cfg = load_config([*case.overrides, *overrides])
        length = cfg.sim.horizon if case.from_start else steps
        show_line(f"{case.skip}: building two simulators")
        with_it = build(cfg, batch, length, from_start=case.from_start)
        skips = Skips(**{case.skip: False})
        without = build(cfg, batch, length, from_start=case.from_start, like=with_it, skips=skips)
        for kind in case.kinds[: 1 if quick else None]:
            show_line(f"{case.skip}: {kind}, {batch} environment(s) on {cfg.sim.device}")
            try:
                yield _row(case, with_it, without, kind, repeats)
            except MemoryError as error:
                refused.append(f"{case.skip}, {batch} environment(s): {error}")
        del with_it, without


def _row(case: SkipCase, with_it: Workload, without: Workload, kind: str, repeats: int) -> dict[str, object]:
    cfg, simulator = with_it.cfg, with_it.simulator
    loss, gradient = _differences(with_it, without, kind == GRADIENT)
    seconds = _alternate([with_it.call(kind), without.call(kind)], repeats)
    ms = np.median(seconds, axis=0) / with_it.steps * 1e3
    ratios = seconds[:, 1] / seconds[:, 0]
    worst = max(loss, gradient) if kind == GRADIENT else loss
    return {
        "skip": case.skip,
        "task": cfg.task.name,
        "device": simulator.device,
        "precision": simulator.precision,
        "batch": simulator.batch,
        "what": kind,
        "ms": round(float(ms[0]), 3),
        "ms_without": round(float(ms[1]), 3),
        "ratio": round(float(np.median(ratios)), 3),
        "ratio_min": round(float(ratios.min()), 3),
        "ratio_max": round(float(ratios.max()), 3),
        "loss_difference": f"{loss:.1e}",
        "gradient_difference": f"{gradient:.1e}" if kind == GRADIENT else "",
        "equal": bool(worst < TOLERANCE[simulator.precision]),
    }


def _alternate(calls: Sequence[Callable[[], object]], repeats: int) -> np.ndarray:
    """Time calls in turn, each first as often as the others; seconds, shape [repeats, call]."""
    for call in calls:
        for _ in range(WARM_UP):
            call()
    seconds = np.empty((repeats, len(calls)))
    for i in range(repeats):
        for k in range(len(calls)) if i % 2 == 0 else reversed(range(len(calls))):
            start = time.perf_counter()
            calls[k]()
            seconds[i, k] = time.perf_counter() - start
    return seconds


def _differences(a: Workload, b: Workload, gradient: bool) -> tuple[float, float]:
    """Largest difference of the weighted losses and of the gradients, relative to the largest component."""
    results = [load.simulator.rollout(load.actions, gradient=gradient) for load in (a, b)]
    weights = [term.weight for term in a.simulator.terms]
    losses = [r.step_terms @ weights for r in results]
    gradients = [cast(np.ndarray, r.gradient) for r in results]
    return _relative(*losses), _relative(*gradients) if gradient else 0.0


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max() / max(np.abs(a).max(), np.finfo(float).tiny))
