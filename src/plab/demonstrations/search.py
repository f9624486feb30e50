"""Search for demonstrations of geometric targets: Adam from many starts, in one batch.

The candidates of a configuration are random starts with different learning rates, what is recorded already,
and, where bodies are to be carried, the straight way. Every so often all are scored in the hard contact
model, and the best actions ever seen are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from plab.config import Config, TrajectoryConfig, build_scene
from plab.demonstrations import known_actions
from plab.problem import Problem
from plab.progress import show_progress
from plab.scene import MANIPULATOR_SHAPES, Scene
from plab.targets import EPISODE_STEPS, BodiesTarget, make_recipe
from plab.targets.scripted import DECIMALS, Track

__all__ = ["Found", "search"]


SQUEEZES = (0.01, 0.02)
"""How far gripping manipulators press into a body before they carry it [domain units]."""


@dataclass(frozen=True)
class Found:
    """The best that a search found for one configuration.

    Attributes:
        score: Score in the hard contact model.
        actions: The actions that reach it, in [-1, 1], rounded as they are recorded, shape [T, A].
    """

    score: float
    actions: np.ndarray


def search(
    cfgs: Sequence[Config], lrs: Sequence[float], iterations: int, every: int, seed: int = 0
) -> list[Found]:
    """Search for the best actions of some configurations of one task.

    Args:
        cfgs: Configurations; contact model, softness and Adam's other settings are the first one's method.
        lrs: Learning rates: one candidate each per configuration, and one more from the recorded actions.
        iterations: Updates of every candidate.
        every: Updates between evaluations in the hard contact model.
        seed: Seed of the candidates' first actions.

    Returns:
        The best per configuration.
    """
    starts, owners, rates = _candidates(cfgs, lrs, seed)
    problem = Problem([cfgs[owner] for owner in owners])
    parameters = [torch.tensor(start, requires_grad=True) for start in starts]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(parameters, rates, strict=True)]
    method = cfgs[0].method_as(TrajectoryConfig)
    first, second = method.betas
    adam = torch.optim.Adam(groups, betas=(first, second), eps=method.eps)
    best: dict[int, Found] = {}
    title = f"{cfgs[0].task.name}, {len(parameters)} candidates"
    with show_progress(title, 0, iterations, enabled=cfgs[0].progress) as report:
        for iteration in range(iterations + 1):
            if iteration % every == 0 or iteration == iterations:
                _evaluate(problem, parameters, owners, best)
                report(iteration, " ".join(f"{best[k].score:.3f}" for k in sorted(best)))
            if iteration < iterations:
                _improve(problem, cfgs[0], parameters, adam)
    return [best[owner] for owner in range(len(cfgs))]


def _candidates(
    cfgs: Sequence[Config], lrs: Sequence[float], seed: int
) -> tuple[list[np.ndarray], list[int], list[float]]:
    """First actions, number of the configuration and learning rate of every candidate."""
    rng = np.random.default_rng(seed)
    starts: list[np.ndarray] = []
    owners: list[int] = []
    rates: list[float] = []
    for owner, cfg in enumerate(cfgs):
        dim = sum(len(m.scale) for m in cfg.task.manipulators.values())
        known = known_actions(cfg)
        size = cfg.method_as(TrajectoryConfig).action_init
        starts += [rng.uniform(-size, size, (cfg.sim.horizon, dim)) for _ in lrs]
        rates += lrs
        carried = carry(build_scene(cfg), cfg.task.target)
        for start in [known, *carried]:
            if start is not None:
                whole = np.zeros((cfg.sim.horizon, dim))
                whole[: len(start)] = start[: cfg.sim.horizon]
                starts.append(whole)
                rates.append(min(lrs))
        owners += [owner] * (len(starts) - len(owners))
    return starts, owners, rates


def carry(scene: Scene, target: Mapping[str, Any]) -> list[np.ndarray]:
    """Guess actions that carry bodies to where a target of bodies has them, gripped between manipulators.

    Every manipulator belongs to the body nearest to it, and every body to one of the target's, so that the
    ways are shortest in all.

    Args:
        scene: The scene.
        target: The ``target`` section of its task.

    Returns:
        Actions, each of shape [EPISODE_STEPS, A], one for each of :data:`SQUEEZES`; none if the target is not
        of as many bodies as the scene.
    """
    recipe = make_recipe(target)
    tools = [m for m in scene.manipulators if m.action_dim]
    if not isinstance(recipe, BodiesTarget) or len(recipe.bodies) != len(scene.bodies):
        return []
    if any(MANIPULATOR_SHAPES[m.shape].motion != "translate" for m in tools):
        return []
    bodies = np.array([body.center for body in scene.bodies])
    ways = np.array([body.center for body in recipe.bodies.values()])[None] - bodies[:, None]
    _, goals = linear_sum_assignment(np.linalg.norm(ways, axis=2))
    guesses = []
    for squeeze in SQUEEZES:
        tracks = [Track(tool) for tool in tools]
        for track, tool in zip(tracks, tools, strict=True):
            offsets = bodies - np.asarray(tool.position)
            owner = int(np.argmin(np.linalg.norm(offsets, axis=1)))
            track.go(squeeze * offsets[owner] / np.linalg.norm(offsets[owner]), 2)
            track.go(ways[owner, goals[owner]], EPISODE_STEPS - 4)
        guesses.append(np.concatenate([track.actions() for track in tracks], axis=1))
    return guesses


def _improve(
    problem: Problem, cfg: Config, parameters: list[torch.Tensor], adam: torch.optim.Optimizer
) -> None:
    problem.simulator.set_contact(cfg.method.contact, cfg.method.softness)
    actions = np.stack([p.detach().numpy() for p in parameters])
    gradient = cast(np.ndarray, problem.rollout(actions, gradient=True).gradient)
    for parameter, slope in zip(parameters, gradient, strict=True):
        parameter.grad = torch.from_numpy(slope.copy())
    adam.step()
    with torch.no_grad():
        for parameter in parameters:
            parameter.clamp_(-1.0, 1.0)


def _evaluate(
    problem: Problem, parameters: list[torch.Tensor], owners: list[int], best: dict[int, Found]
) -> None:
    """Score all candidates in the hard model and keep the best of each configuration."""
    problem.simulator.set_contact("hard")
    actions = np.round(np.stack([p.detach().numpy() for p in parameters]), DECIMALS)
    judged = problem.rollout(actions, gradient=False).scores
    for owner, scores, tried in zip(owners, judged, actions, strict=True):
        if owner not in best or scores.score > best[owner].score:
            best[owner] = Found(scores.score, tried)
