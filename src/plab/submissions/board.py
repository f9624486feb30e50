"""What the leaderboard shows: tables of entries that were judged alike, with the paper's and plab's own."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from plab.config import Config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.families import GRADIENT
from plab.report.methods import method
from plab.report.reference import PAPER_SEED_COUNT, paper_table
from plab.report.series import BUDGETS
from plab.results import ResultsError, Row, config_dict
from plab.results.examples import example_archive
from plab.results.table import readable_rows
from plab.submissions.collecting import steps_to_best, submission_files
from plab.submissions.files import read
from plab.submissions.schema import UNSEEN, Card, Configuration, Digests, Submission, SubmissionError
from plab.submissions.verifying import BROKE_OFF, HOLDS, LIES, read_verification
from plab.targets.store import PHYSICS_VERSION

__all__ = ["Board", "BoardTable", "Line", "board"]

PAPER = Card(
    name="",
    authors=("Huang et al.",),
    link="https://arxiv.org/abs/2104.03311",
    budget=0,
    hardware="",
    gradient=False,
)
OWN = replace(PAPER, authors=("plab contributors",), link="")

_EPISODE = 50
_PAPER_STEPS = {True: 200 * _EPISODE, False: 10_000 * _EPISODE}
"""Environment steps of the paper's methods, with the gradient and without: their episodes are 50 steps."""


@dataclass(frozen=True)
class Point:
    """A score that was reached after so many environment steps, in a task and a variant; ``exact`` is that in
    float64, or NaN."""

    configuration: tuple[str, str]
    steps: int
    score: float
    exact: float = math.nan


@dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        card: Who it is of.
        track: ``plans`` or ``policies``.
        status: ``verified``, ``claimed``, ``printed`` (the paper's) or ``own runs`` (plab's).
        covered: Number of configurations with a score.
        budgets: Mean score of all configurations of the table within each budget, one that is missing
            counted as 0; None where there is nothing within it.
        score: The same without a limit.
        exact: The same in float64; None if that is not known.
        tasks: The same by task; None for tasks without a score.
    """

    card: Card
    track: str
    status: str
    covered: int
    budgets: tuple[float | None, ...]
    score: float
    exact: float | None
    tasks: tuple[float | None, ...]


@dataclass(frozen=True)
class BoardTable:
    """A table: all its numbers are of one protocol and one set of targets.

    Attributes:
        title: Its heading.
        protocol: What they are scores of.
        expected: Number of configurations.
        lines: Best first.
    """

    title: str
    protocol: str
    expected: int
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Board:
    """All tables, and why some files are in none of them."""

    sections: tuple[BoardTable, ...]
    left_out: tuple[str, ...]


_PLAYED = "The score is that of one episode in the hard contact model, of the plan or policy handed in."
_ORIGIN = {
    "plab": "Start, numbers and floor are plab's (protocol=plab)",
    "release": "Start, numbers and floor are those of the authors' code (protocol=release)",
}
_SETS = {
    "suite": ("plab's suite", "the targets of plab's own recipes"),
    "unseen": (
        "Unseen configurations",
        f"drawn starts and targets ({UNSEEN[0]} to {UNSEEN[-1]}) of each task",
    ),
    "authors": ("The authors' suite", "the authors' target files"),
}
_USUAL = (("suite", "plab"), ("unseen", "plab"), ("authors", "plab"), ("authors", "release"))
_RARE = (("suite", "release"), ("unseen", "release"))


def board(folder: Path, overrides: Sequence[str] = ()) -> Board:
    """Make the leaderboard of a folder of submissions, each with what ``plab.verify`` has kept beside it.

    Overrides are settings of every configuration that belongs here, if not plab's own.

    Raises:
        SubmissionError: If there is no such folder.
        plab.config.ConfigError: If an override does not fit.
    """
    if not folder.is_dir():
        raise SubmissionError(f"there is no folder {folder}")
    tables: dict[tuple[str, str], list[Line]] = defaultdict(list)
    left_out: list[str] = []
    for path in submission_files(folder):
        try:
            for table, line in _handed_in(path, tuple(overrides)):
                tables[table].append(line)
        except ResultsError as error:
            left_out.append(str(error))
    for table, line in _own():
        tables[table].append(line)
    sections = []
    for kind, terms in (*_USUAL, *(table for table in _RARE if tables[table])):
        title, targets = _SETS[kind]
        if terms != "plab":
            title += " on its terms" if kind == "authors" else " on the authors' terms"
        protocol = f"{_ORIGIN[terms]}; {targets}. {_PLAYED}"
        lines = _best_first(tables[kind, terms])
        sections.append(BoardTable(title, protocol, len(_expected(kind)), lines))
    return Board((*sections, _paper()), tuple(left_out))


def _best_first(lines: Iterable[Line]) -> tuple[Line, ...]:
    return tuple(sorted(lines, key=lambda line: (-line.score, line.card.name)))


def _expected(kind: str) -> list[tuple[str, str]]:
    variants = UNSEEN if kind == "unseen" else SUITE_VARIANTS
    return [(task, variant) for task in suite_tasks() for variant in variants]


def _line(card: Card, track: str, status: str, kind: str, points: Sequence[Point]) -> Line:
    """Sum up what was reached."""
    expected = _expected(kind)
    best = _best(points, math.inf)
    exact = [point.exact for point in best.values()]
    tasks = []
    for task in suite_tasks():
        own = [point.score for (name, _), point in best.items() if name == task]
        count = sum(name == task for name, _ in expected)
        tasks.append(sum(own) / count if own else None)
    return Line(
        card,
        track,
        status,
        covered=len(best),
        budgets=tuple(
            sum(point.score for point in found.values()) / len(expected) if found else None
            for found in (_best(points, limit) for limit in BUDGETS)
        ),
        score=sum(point.score for point in best.values()) / len(expected),
        exact=None if any(map(math.isnan, exact)) else sum(exact) / len(expected),
        tasks=tuple(tasks),
    )


def _best(points: Sequence[Point], limit: float) -> dict[tuple[str, str], Point]:
    """Return the best point of each configuration within a budget."""
    found: dict[tuple[str, str], Point] = {}
    for point in points:
        best = found.get(point.configuration)
        if point.steps <= limit and (best is None or point.score > best.score):
            found[point.configuration] = point
    return found


# ------------------------------------------------------------------------------------------------- handed in


@functools.cache
def _composed(configuration: Configuration, overrides: tuple[str, ...]) -> Config:
    return configuration.config(overrides)


@functools.cache
def _digests(configuration: Configuration, overrides: tuple[str, ...]) -> Digests:
    return Digests.of(_composed(configuration, overrides))


def _stranger(submission: Submission, overrides: tuple[str, ...]) -> str | None:
    """Return the name of a configuration that is another one here, None if there is none."""
    for entry in submission.entries:
        configuration = entry.configuration
        # The scene is the same, and the authors' files need not be here.
        known = _digests(replace(configuration, targets="suite"), overrides)
        if entry.digests.scene != known.scene:
            return f"the scene of {configuration.name}"
        if configuration.targets == "suite" and entry.digests.target != known.target:
            return f"the target of {configuration.name}"
    return None


def _handed_in(path: Path, overrides: tuple[str, ...]) -> Iterator[tuple[tuple[str, str], Line]]:
    """Yield the lines of a submission, with the tables that they belong to.

    Raises:
        ResultsError: If it belongs into none.
    """
    submission = read(path)
    if submission.card is None:
        raise SubmissionError(f"{path} has no card: python -m plab.submit makes a submission of recordings")
    if submission.physics != PHYSICS_VERSION:
        raise SubmissionError(
            f"{path} is of physics version {submission.physics}, the leaderboard of {PHYSICS_VERSION}"
        )
    if other := _stranger(submission, overrides):
        raise SubmissionError(f"{path}: {other} is another one than on this leaderboard")
    verification = read_verification(submission)
    status = "claimed"
    if verification is not None:
        wrong = [v for v in verification.verdicts if v.outcome in (LIES, BROKE_OFF)]
        if wrong:
            raise SubmissionError(f"{path}: {len(wrong)} claim(s) do not hold; {wrong[0].why}")
        status = "verified" if verification.outcomes == {HOLDS} else "claimed"
    tables: dict[tuple[str, str], list[Point]] = defaultdict(list)
    for number, entry in enumerate(submission.entries):
        scores = {} if verification is None else verification.verdicts[number].scores
        own, score = entry.configuration, scores.get("float32", entry.score)
        point = Point((own.task, own.variant), entry.steps, score, scores.get("float64", math.nan))
        tables["unseen" if own.unseen else own.targets, own.terms].append(point)
    for table, points in tables.items():
        yield table, _line(submission.card, submission.track, status, table[0], points)


# -------------------------------------------------------------------------------------------- first entries


@functools.cache
def _own() -> tuple[tuple[tuple[str, str], Line], ...]:
    """Return the lines of plab's own runs, of the archives that come with it, and their tables."""
    found = []
    archives = {
        "example": ("suite", "plab"),
        "targets": ("authors", "plab"),
        "release": ("authors", "release"),
    }
    for name, table in archives.items():
        for card, runs in _runs(name):
            points = [Point(_which(row), steps_to_best(row), row.values["score_best"]) for row in runs]
            found.append((table, _line(card, "plans", "own runs", table[0], points)))
    return tuple(found)


@functools.cache
def _runs(name: str) -> list[tuple[Card, list[Row]]]:
    """Return the runs of an archive by method: of gradient methods with seed 0, whose targets are today's."""
    groups: dict[str, list[Row]] = defaultdict(list)
    for row in readable_rows(example_archive(name))[0]:
        gradient = method(row.values["method"]).kind == GRADIENT
        if row.values["seed"] == 0 and gradient and _of_today(row.config):
            groups[row.values["method"]].append(row)
    look = replace(OWN, gradient=True, hardware="NVIDIA H200")
    return [(replace(look, name=method(own).label), rows) for own, rows in groups.items()]


def _of_today(config: Mapping[str, Any]) -> bool:
    """Return whether a run's target is what its task has today; those in files of the authors are."""
    if config["targets"]["source"] is not None:
        return True
    today = _composed(Configuration(config["task"]["name"], str(config["variant"])), ())
    return config["task"]["target"] == config_dict(today)["task"]["target"]


def _which(row: Row) -> tuple[str, str]:
    return row.values["task"], row.values["variant"]


def _paper() -> BoardTable:
    """Return the paper's table, with plab's runs that were judged as it does."""
    table = paper_table("iou_per_configuration")
    lines = []
    for name, rows in table.groupby("method", sort=False):
        look = method(str(name))
        gradient = look.kind == GRADIENT
        steps = _PAPER_STEPS[gradient]
        points = [Point((row.task, row.variant), steps, row.iou_mean) for row in rows.itertuples()]
        card = replace(PAPER, name=look.label, gradient=gradient)
        lines.append(_line(card, "plans" if gradient else "policies", "printed", "authors", points))
    for card, runs in _runs("release"):
        points = [Point(_which(row), _PAPER_STEPS[True], row.values["score"]) for row in runs]
        lines.append(_line(card, "plans", "own runs", "authors", points))
    protocol = (
        f"{_ORIGIN['release']}; the authors' target files. The score is that of the last iteration as it was "
        "simulated, for Adam and GD in the soft contact model, as the authors' code logs it: mean over "
        f"{PAPER_SEED_COUNT} seeds in the paper, of one seed of plab's runs. Nothing handed in is judged "
        "like this, so that these numbers compare with those of no other table."
    )
    return BoardTable("The paper's table", protocol, len(_expected("authors")), _best_first(lines))
