"""The leaderboard as one static page, in the style of the page of results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plab.config.suite import suite_tasks
from plab.report.budgets import BUDGETS
from plab.report.templates import asset, render
from plab.submissions.board import Board
from plab.submissions.verifying import TOLERANCE

__all__ = ["write_leaderboard"]

_PACKAGE = "plab.submissions"


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
    html = render(
        "leaderboard.html",
        _PACKAGE,
        style=asset("page.css") + asset("leaderboard.css", _PACKAGE),
        script=asset("theme.js") + asset("leaderboard.js", _PACKAGE),
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
