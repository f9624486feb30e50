"""Functions for the cells of the report notebooks in ``reports/``: find runs, show tables and figures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from html import escape

import numpy as np
import pandas as pd
from IPython.display import HTML, Image, Markdown, display

from plab.config.selection import select
from plab.report.collect import NAMES, Runs, collect
from plab.report.figures import Drawing, style
from plab.report.reference import Benchmark, measured
from plab.report.tables import Table, aligned
from plab.results import ResultsError
from plab.results.examples import measurements, resolve

_DPI = 180


def gather(results: Sequence[str], words: Sequence[str] = ()) -> Runs:
    """Find the runs; show a message if there are none.

    Args:
        results: Folders or archives; ``example`` is the bundled archive.
        words: Selection of runs, as for ``plab report``.
    """
    runs = collect([resolve(source) for source in results], select(words, NAMES))
    if runs.table.empty:
        say(
            f"There are no finished runs in {', '.join(map(str, results))}: `plab run task=Move` "
            "makes one, and `results=example` shows those that come with plab."
        )
    return runs


def show_origin(runs: Runs, command: str) -> None:
    """Show the command and the result files behind the following output."""
    say(
        f"Made by `{command}` from {len(runs.table)} run(s); SHA-256 over them `{runs.digest}`. "
        + " ".join(f"{line}." for line in runs.left_out)
    )
    names = runs.table.reindex(columns=[*NAMES, "config_hash", "path"])
    files = names.to_html(index=False, border=0, classes="plain")
    display(HTML(f"<details><summary>The result files</summary>{files}</details>"))


def say(text: str) -> None:
    """Show a line of Markdown."""
    display(Markdown(text))


def show_table(table: Table | pd.DataFrame, notes: Sequence[str] = ()) -> None:
    """Show a table of the report, or cells of text."""
    whole = table if isinstance(table, Table) else Table("", "", "", table, table, notes=list(notes))
    cells = whole.cells
    shown = cells.style.hide(axis="index").format(escape="html")
    if whole.bold is not None:
        weights = np.where(whole.bold, "font-weight: bold", "")
        shown = shown.apply(lambda _: weights, axis=None)
    numbers = [name for name, side in zip(cells.columns, aligned(cells), strict=True) if side == "r"]
    shown = shown.set_properties(subset=numbers, **{"text-align": "right"})
    display(HTML(f'<div class="scroll">{shown.to_html()}</div>'))
    display(HTML(f'<p class="note">{escape(" ".join(whole.notes))}</p>'))


def show_figure(drawing: Drawing | None) -> None:
    """Show a figure with its notes, or a message for None."""
    if drawing is None:
        say("*Nothing to draw: there are no runs for it.*")
        return
    content = io.BytesIO()
    with style():
        drawing.figure.savefig(content, format="png", dpi=_DPI)
    width = int(drawing.figure.get_figwidth() * 110)
    display(Image(content.getvalue(), width=width, alt=drawing.name))
    display(HTML(f'<p class="note">{escape(" ".join(drawing.notes))}</p>'))


def benchmark(folder: str, which: Benchmark) -> pd.DataFrame | None:
    """Return the rows of a benchmark, or show the command that generates its file.

    Args:
        folder: Folder of the benchmarks' files; ``example`` is the bundled one.
        which: The benchmark.

    Returns:
        Its rows; None if the file is missing or invalid.
    """
    try:
        return measured(measurements(folder) / which.file, which)
    except ResultsError as error:
        text = str(error)
        say(f"{text[0].upper()}{text[1:]}.")
        return None
