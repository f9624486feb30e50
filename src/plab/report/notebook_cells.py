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
from plab.report.figures import Drawing, fix_layout, style
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
    lines = [
        f"Made by <code>{escape(command)}</code> from {len(runs.table)} run(s); SHA-256 over them "
        f"<code>{runs.digest}</code>."
    ]
    lines += [escape(line) + "." for line in runs.left_out()]
    names = runs.table.reindex(columns=["task", "variant", "method", "seed", "config_hash", "path"])
    files = names.to_html(index=False, border=0, classes="plain")
    display(HTML(f"<p>{' '.join(lines)}</p><details><summary>The result files</summary>{files}</details>"))


def say(text: str) -> None:
    """Show a line of Markdown."""
    display(Markdown(text))


def show_table(table: Table | pd.DataFrame, notes: Sequence[str] = ()) -> None:
    """Show a table of the report, or cells of text."""
    whole = table if isinstance(table, Table) else Table("", "", "", table, table, notes=list(notes))
    sides = ["number" if side == "r" else "" for side in aligned(whole.cells)]
    names = zip(whole.cells.columns, sides, strict=True)
    head = "".join(f'<th class="{side}">{escape(str(name))}</th>' for name, side in names)
    body = ""
    for r, line in enumerate(whole.cells.to_numpy(dtype=str)):
        bold = [whole.bold is not None and whole.bold[r, c] for c in range(len(line))]
        body += f"<tr>{''.join(map(_cell, line, bold, sides))}</tr>"
    html = f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    display(HTML(html + f'<p class="note">{escape(" ".join(whole.notes))}</p>'))


def _cell(text: str, bold: bool, side: str) -> str:
    shown = f"<b>{escape(text)}</b>" if bold else escape(text)
    return f'<td class="{side}">{shown}</td>' if side else f"<td>{shown}</td>"


def show_figure(drawing: Drawing | None) -> None:
    """Show a figure with its notes, or a message for None."""
    if drawing is None:
        say("*Nothing to draw: there are no runs for it.*")
        return
    content = io.BytesIO()
    with style():
        fix_layout(drawing.figure)
        drawing.figure.savefig(content, format="png", dpi=_DPI)
    width = int(np.ceil(drawing.figure.get_figwidth() * 110))
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
