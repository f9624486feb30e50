"""The leaderboard as one static page, in the style of the page of results."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from plab.report.budgets import BUDGETS
from plab.submissions.board import Board
from plab.submissions.verifying import TOLERANCE
from plab.suite import suite_tasks

__all__ = ["write_leaderboard"]


def write_leaderboard(board: Board, out: Path, origin: Mapping[str, Any]) -> Path:
    """Write ``index.html``; it needs no server and no network.

    Args:
        board: What it shows.
        out: Folder to write to.
        origin: What is said about where the page comes from: ``command``, ``plab``, ``physics``,
            ``overrides``.

    Returns:
        The page.
    """
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(
        _text("plab.submissions", "leaderboard.html")
    )
    html = template.render(
        style=_text("plab.report", "page.css") + _text("plab.submissions", "leaderboard.css"),
        script=_text("plab.report", "theme.js") + _text("plab.submissions", "leaderboard.js"),
        board=board,
        budgets=[_short(budget) for budget in BUDGETS],
        tasks=suite_tasks(),
        tolerance=TOLERANCE,
        origin=origin,
    )
    out.mkdir(parents=True, exist_ok=True)
    path = out / "index.html"
    path.write_text(html, encoding="utf-8", newline="\n")
    return path


def _short(count: float) -> str:
    """Write a round number with a letter: 10k."""
    return f"{count / 1e6:g}M" if count >= 1e6 else f"{count / 1e3:g}k"


def _text(package: str, name: str) -> str:
    return (files(package) / "web" / name).read_text(encoding="utf-8")
