"""One static page from a folder of submissions: tracks, equal budgets, one table for each protocol.

plab leaderboard submissions
plab leaderboard submissions --out public/leaderboard

Run plab.verify on the folder before: what it has kept is shown. The page is index.html; it needs no server.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import plab
from plab.cli.arguments import Parser, folder
from plab.cli.command import command_line
from plab.config.suite import suite_tasks
from plab.errors import tell
from plab.report.series import BUDGETS
from plab.report.templates import asset, render
from plab.submissions.board import board
from plab.submissions.verifying import TOLERANCE
from plab.targets.store import PHYSICS_VERSION

__all__ = ["main"]

_PACKAGE = "plab.submissions"
"""Where the files of the page are."""


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    parser = Parser("leaderboard", __doc__)
    parser.add_argument("folder", type=folder, help="folder of submissions")
    what = "settings of a leaderboard of your own, such as sim.grid_size=32"
    parser.add_argument("overrides", nargs="*", help=what)
    what = "folder to write to (default: reports/leaderboard)"
    parser.add_argument("--out", type=folder, default=Path("reports/leaderboard"), help=what)
    options = parser.parse_intermixed_args(argv)
    origin = {
        "command": shlex.join(["plab", "leaderboard", *argv]),
        "plab": plab.__version__,
        "physics": PHYSICS_VERSION,
        "overrides": options.overrides,
    }
    made = board(options.folder, options.overrides)
    html = render(
        "leaderboard.html",
        _PACKAGE,
        style=asset("page.css") + asset("leaderboard.css", _PACKAGE),
        script=asset("theme.js") + asset("leaderboard.js", _PACKAGE),
        board=made,
        budgets=[f"{count / 1e6:g}M" if count >= 1e6 else f"{count / 1e3:g}k" for count in BUDGETS],
        tasks=suite_tasks(),
        tolerance=TOLERANCE,
        origin=origin,
    )
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "index.html"
    path.write_text(html, encoding="utf-8", newline="\n")
    for line in made.left_out:
        tell(f"left out: {line}")
    print(f"{path}: {sum(len(section.lines) for section in made.sections)} lines")
