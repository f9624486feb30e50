"""Leaderboard tables: comparable entries, and the paper's numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from plab.config.families import GRADIENT
from plab.config.suite import PAPER_SEEDS, SUITE_VARIANTS, suite_tasks
from plab.report.methods import method
from plab.report.reference import paper_table
from plab.report.statistics import BUDGETS
from plab.results import ResultsError
from plab.submissions.submission import UNSEEN, Card, SubmissionError, read
from plab.submissions.verifying import BROKE_OFF, HOLDS, LIES, configs_of, read_verification, submission_files

PAPER = Card("", ["Huang et al."], "https://arxiv.org/abs/2104.03311", budget=0, hardware="", gradient=False)
_PAPER_STEPS = {True: 200 * 50, False: 10_000 * 50}
"""Environment steps of the paper's methods, with and without gradient; its episodes have 50 steps."""

_TABLES = {
    "suite": ("plab's suite", "the targets of plab's own recipes", SUITE_VARIANTS),
    "unseen": ("Unseen configurations", f"drawn by seed_scene, {UNSEEN[0]} to {UNSEEN[-1]}", UNSEEN),
}
"""Heading, description and variants of a set of configurations."""


def board(folder: Path, overrides: Sequence[str] = ()) -> tuple[list[dict[str, Any]], list[str]]:
    """Generate the leaderboard for a folder of submissions and their verifications by ``plab verify``.

    Args:
        folder: The folder.
        overrides: Overrides of all configurations of the table.

    Returns:
        Tables for the page, each with ``title``, ``protocol`` (conditions of the scores, in sentences),
        ``expected`` (number of configurations) and ``lines`` of :func:`_line`, best first; and a message for
        each file that is not in any table.

    Raises:
        SubmissionError: If the folder does not exist.
        plab.config.ConfigError: If an override is invalid.
    """
    if not folder.is_dir():
        raise SubmissionError(f"there is no folder {folder}")
    lines: dict[str, list[dict[str, Any]]] = {kind: [] for kind in _TABLES}
    left_out: list[str] = []
    for path in submission_files(folder):
        try:
            for kind, line in _submission_lines(path, overrides):
                lines[kind].append(line)
        except ResultsError as error:
            left_out.append(str(error))
    played = "Score of one episode of the submitted plan or policy in the hard contact model; protocol=plab"
    sections = [
        _table(title, f"{played}, {what}.", variants, lines[kind])
        for kind, (title, what, variants) in _TABLES.items()
    ]
    return [*sections, _paper()], left_out


def _table(
    title: str, protocol: str, variants: Sequence[str], lines: Iterable[dict[str, Any]]
) -> dict[str, Any]:
    best_first = sorted(lines, key=lambda line: (-line["score"], line["card"].name))
    expected = len(suite_tasks()) * len(variants)
    return {"title": title, "protocol": protocol, "expected": expected, "lines": best_first}


def _line(
    card: Card, track: str, status: str, variants: Sequence[str], points: pd.DataFrame
) -> dict[str, Any]:
    """Return a line of a table, given ``points`` with the columns task, variant, steps and score.

    Returns:
        ``card``; ``track`` (``plans`` or ``policies``); ``status`` (``verified``, ``claimed`` or, for the
        paper's, ``printed``); ``covered``, number of configurations with a score; ``score``,
        mean over all configurations of the table, missing ones counting as 0; ``budgets``, the same within
        each budget, None without entries; ``tasks``, the same by task, None without scores.
    """
    each, by = len(variants), ["task", "variant"]
    expected = len(suite_tasks()) * each
    within = [points[points["steps"] <= limit].groupby(by)["score"].max() for limit in BUDGETS]
    best = points.groupby(by)["score"].max()
    tasks = (best.groupby("task").sum() / each).to_dict()
    return {
        "card": card,
        "track": track,
        "status": status,
        "covered": len(best),
        "budgets": [float(scores.sum()) / expected if len(scores) else None for scores in within],
        "score": float(best.sum()) / expected,
        "tasks": [tasks.get(task) for task in suite_tasks()],
    }


# ------------------------------------------------------------------------------------------------ submissions


def _submission_lines(path: Path, overrides: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the lines of a submission with their tables.

    Raises:
        ResultsError: If the submission does not belong to any table.
    """
    submission = read(path)
    if submission.card is None:
        raise SubmissionError(f"{path} has no card: use plab submit to turn recordings into a submission")
    configs_of(submission, overrides)
    verdicts, status = read_verification(submission), "claimed"
    if wrong := [one for one in verdicts if one.outcome in (LIES, BROKE_OFF)]:
        raise SubmissionError(f"{path}: {len(wrong)} claim(s) do not hold; {wrong[0].why}")
    if verdicts and all(one.outcome == HOLDS for one in verdicts):
        status = "verified"
    found = []
    for number, entry in enumerate(submission.entries):
        own, score = entry.configuration, entry.score
        if verdicts and not math.isnan(verdicts[number].score):
            score = verdicts[number].score
        found.append((own.task, own.variant, entry.steps, score))
    points = pd.DataFrame(found, columns=["task", "variant", "steps", "score"])
    for kind, (_, _, variants) in _TABLES.items():
        inside = points[points["variant"].isin(variants)]
        if len(inside):
            yield kind, _line(submission.card, submission.track, status, variants, inside)


def _paper() -> dict[str, Any]:
    """Return the paper's table."""
    lines = []
    for name, own in paper_table("iou_per_configuration").groupby("method", sort=False):
        look = method(str(name))
        gradient = look.kind == GRADIENT
        card = replace(PAPER, name=look.label, gradient=gradient)
        points = own[["task", "variant"]].assign(steps=_PAPER_STEPS[gradient], score=own["iou_mean"])
        track = "plans" if gradient else "policies"
        lines.append(_line(card, track, "printed", SUITE_VARIANTS, points))
    protocol = (
        "protocol=release, the authors' target files. The score is that of the last iteration as it was "
        "simulated, for Adam and GD in the soft contact model, as the authors' code logs it: mean over "
        f"{len(PAPER_SEEDS)} seeds. Submissions are scored differently, so these numbers are not comparable "
        "with those of other tables."
    )
    return _table("The paper's table", protocol, SUITE_VARIANTS, lines)
