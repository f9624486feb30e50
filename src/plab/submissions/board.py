"""Tables of the leaderboard: entries judged alike, with the paper's and plab's own."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from plab.config.families import GRADIENT
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.report.methods import method
from plab.report.reference import PAPER_SEED_COUNT, paper_table
from plab.report.series import BUDGETS
from plab.results import ResultsError, Row
from plab.results.examples import example_archive
from plab.results.table import readable_rows
from plab.submissions.collecting import steps_to_best, submission_files
from plab.submissions.submission import (
    UNSEEN,
    Card,
    Configuration,
    Digests,
    Submission,
    SubmissionError,
    read,
)
from plab.submissions.verifying import BROKE_OFF, HOLDS, LIES, read_verification
from plab.targets.store import PHYSICS_VERSION

PAPER = Card("", ("Huang et al.",), "https://arxiv.org/abs/2104.03311", budget=0, hardware="", gradient=False)
OWN = Card("", ("plab contributors",), "", budget=0, hardware="NVIDIA H200", gradient=True)

_PAPER_STEPS = {True: 200 * 50, False: 10_000 * 50}
"""Environment steps of the paper's methods, with the gradient and without: its episodes have 50 steps."""

TableKey: TypeAlias = tuple[str, str]
"""Set of configurations (``suite``, ``unseen`` or ``authors``) and protocol (``plab`` or ``release``)."""


@dataclass(frozen=True)
class Point:
    """A score in a task and variant.

    Attributes:
        configuration: Task and variant.
        steps: Environment steps until it was reached.
        score: The score in float32.
        exact: The score in float64, or NaN.
    """

    configuration: tuple[str, str]
    steps: int
    score: float
    exact: float = math.nan


@dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        card: The method.
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
        protocol: Conditions of the scores, in sentences.
        expected: Number of configurations.
        lines: Best first.
    """

    title: str
    protocol: str
    expected: int
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Board:
    """All tables, and a line for each file that is in none of them."""

    sections: tuple[BoardTable, ...]
    left_out: tuple[str, ...]


_PLAYED = "The score is that of one episode in the hard contact model, of the plan or policy handed in."
_ORIGIN = {
    "plab": "Start, numbers and floor are plab's (protocol=plab)",
    "release": "Start, numbers and floor are those of the authors' code (protocol=release)",
}
_TARGETS = {
    "suite": "the targets of plab's own recipes",
    "unseen": f"drawn starts and targets ({UNSEEN[0]} to {UNSEEN[-1]}) of each task",
    "authors": "the authors' target files",
}
_TITLES: dict[TableKey, str] = {
    ("suite", "plab"): "plab's suite",
    ("unseen", "plab"): "Unseen configurations",
    ("authors", "plab"): "The authors' suite",
    ("authors", "release"): "The authors' suite on its terms",
    ("suite", "release"): "plab's suite on the authors' terms",
    ("unseen", "release"): "Unseen configurations on the authors' terms",
}
_SHOWN_IF_EMPTY = 4
"""Number of tables, from the first on, that are shown without lines, too."""


def board(folder: Path, overrides: Sequence[str] = ()) -> Board:
    """Make the leaderboard of a folder of submissions, each with what ``plab.verify`` has kept beside it.

    Overrides are settings of every configuration that belongs here, if not plab's own.

    Raises:
        SubmissionError: If there is no such folder.
        plab.config.ConfigError: If an override does not fit.
    """
    if not folder.is_dir():
        raise SubmissionError(f"there is no folder {folder}")
    tables: dict[TableKey, list[Line]] = defaultdict(list)
    left_out: list[str] = []
    for path in submission_files(folder):
        try:
            for table, line in _handed_in(path, tuple(overrides)):
                tables[table].append(line)
        except ResultsError as error:
            left_out.append(str(error))
    for archive, table in (("example", ("suite", "plab")), ("targets", ("authors", "plab"))):
        tables[table] += _own_runs(archive, table[0])
    tables["authors", "release"] += _own_runs("release", "authors")
    sections = []
    for number, ((kind, terms), title) in enumerate(_TITLES.items()):
        if tables[kind, terms] or number < _SHOWN_IF_EMPTY:
            protocol = f"{_ORIGIN[terms]}; {_TARGETS[kind]}. {_PLAYED}"
            lines = _best_first(tables[kind, terms])
            sections.append(BoardTable(title, protocol, len(_expected(kind)), lines))
    return Board((*sections, _paper()), tuple(left_out))


def _best_first(lines: Iterable[Line]) -> tuple[Line, ...]:
    return tuple(sorted(lines, key=lambda line: (-line.score, line.card.name)))


def _expected(kind: str) -> list[tuple[str, str]]:
    variants = UNSEEN if kind == "unseen" else SUITE_VARIANTS
    return [(task, variant) for task in suite_tasks() for variant in variants]


def _line(card: Card, track: str, status: str, kind: str, points: Sequence[Point]) -> Line:
    """Summarise the points of a method in a table of some kind of configurations."""
    expected = _expected(kind)
    best = _best(points, math.inf)
    within = [_best(points, limit) for limit in BUDGETS]
    exact = [point.exact for point in best.values()]
    tasks: dict[str, list[float]] = defaultdict(list)
    for (task, _), point in best.items():
        tasks[task].append(point.score)
    each = len(expected) // len(suite_tasks())
    return Line(
        card,
        track,
        status,
        covered=len(best),
        budgets=tuple(sum(p.score for p in f.values()) / len(expected) if f else None for f in within),
        score=sum(point.score for point in best.values()) / len(expected),
        exact=None if any(map(math.isnan, exact)) else sum(exact) / len(expected),
        tasks=tuple(sum(tasks[name]) / each if name in tasks else None for name in suite_tasks()),
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
def _digests(configuration: Configuration, overrides: tuple[str, ...]) -> Digests:
    return Digests.of(configuration.config(overrides))


def _foreign_part(submission: Submission, overrides: tuple[str, ...]) -> str | None:
    """Return the scene or target that differs from the leaderboard's; None if all agree."""
    for entry in submission.entries:
        configuration = entry.configuration
        # The scene does not depend on the target, and the authors' files need not be here.
        known = _digests(replace(configuration, targets="suite"), overrides)
        if entry.digests.scene != known.scene:
            return f"the scene of {configuration.name}"
        if configuration.targets == "suite" and entry.digests.target != known.target:
            return f"the target of {configuration.name}"
    return None


def _handed_in(path: Path, overrides: tuple[str, ...]) -> Iterator[tuple[TableKey, Line]]:
    """Yield the lines of a submission, with their tables.

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
    if other := _foreign_part(submission, overrides):
        raise SubmissionError(f"{path}: {other} is another one than on this leaderboard")
    verification = read_verification(submission)
    status = "claimed"
    if verification is not None:
        wrong = [v for v in verification.verdicts if v.outcome in (LIES, BROKE_OFF)]
        if wrong:
            raise SubmissionError(f"{path}: {len(wrong)} claim(s) do not hold; {wrong[0].why}")
        status = "verified" if verification.outcomes == {HOLDS} else "claimed"
    tables: dict[TableKey, list[Point]] = defaultdict(list)
    for number, entry in enumerate(submission.entries):
        scores = {} if verification is None else verification.verdicts[number].scores
        own, score = entry.configuration, scores.get("float32", entry.score)
        point = Point((own.task, own.variant), entry.steps, score, scores.get("float64", math.nan))
        tables["unseen" if own.unseen else own.targets, own.terms].append(point)
    for table, points in tables.items():
        yield table, _line(submission.card, submission.track, status, table[0], points)


# -------------------------------------------------------------------------------------------- first entries


@functools.cache
def _runs(archive: str) -> dict[Card, list[Row]]:
    """Return the runs of gradient methods with seed 0 in an archive that comes with plab, by method."""
    groups: dict[Card, list[Row]] = defaultdict(list)
    for row in readable_rows(example_archive(archive))[0]:
        look = method(row.values["method"])
        if row.values["seed"] == 0 and look.kind == GRADIENT:
            groups[replace(OWN, name=look.label)].append(row)
    return groups


def _own_runs(archive: str, kind: str) -> Iterator[Line]:
    for card, runs in _runs(archive).items():
        points = [Point(_which(row), steps_to_best(row), row.values["score_best"]) for row in runs]
        yield _line(card, "plans", "own runs", kind, points)


def _which(row: Row) -> tuple[str, str]:
    return row.values["task"], row.values["variant"]


def _paper() -> BoardTable:
    """Return the paper's table, with plab's runs that were judged in the same way."""
    table = paper_table("iou_per_configuration")
    lines = []
    for name, rows in table.groupby("method", sort=False):
        look = method(str(name))
        gradient = look.kind == GRADIENT
        steps = _PAPER_STEPS[gradient]
        points = [Point((row.task, row.variant), steps, row.iou_mean) for row in rows.itertuples()]
        card = replace(PAPER, name=look.label, gradient=gradient)
        lines.append(_line(card, "plans" if gradient else "policies", "printed", "authors", points))
    for card, runs in _runs("release").items():
        points = [Point(_which(row), _PAPER_STEPS[True], row.values["score"]) for row in runs]
        lines.append(_line(card, "plans", "own runs", "authors", points))
    protocol = (
        f"{_ORIGIN['release']}; the authors' target files. The score is that of the last iteration as it was "
        "simulated, for Adam and GD in the soft contact model, as the authors' code logs it: mean over "
        f"{PAPER_SEED_COUNT} seeds in the paper, of one seed of plab's runs. Nothing handed in is judged "
        "like this, so that these numbers compare with those of no other table."
    )
    return BoardTable("The paper's table", protocol, len(_expected("authors")), _best_first(lines))
