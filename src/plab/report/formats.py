"""Formats of tables and numbers: LaTeX, Markdown and CSV."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from plab.report.statistics import Summary

NOTHING = "\N{EN DASH}"
"""Placeholder for missing numbers."""

MINUS = "\N{MINUS SIGN}"
"""Sign of negative numbers."""


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes:
        name: Name of its files.
        form: ``ours``, ``paper`` or ``comparison``: its folder.
        title: Heading.
        cells: Text of the table.
        data: CSV rows with all digits, one per number or group of numbers.
        bold: Mask of bold cells, of the shape of ``cells``; None if none is.
        notes: Notes on the contents and the provenance of the table.
        long: Whether it may be longer than a page.
    """

    name: str
    form: str
    title: str
    cells: pd.DataFrame
    data: pd.DataFrame
    bold: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    long: bool = False

    @property
    def file(self) -> Path:
        """Path of its files below the folder of tables, without suffix."""
        return Path(self.form) / self.name


def number(value: float, decimals: int = 2, *, sign: bool = False) -> str:
    """Format a number with a minus sign instead of a hyphen; a dash if it is missing."""
    if math.isnan(value):
        return NOTHING
    # Without a minus sign for values rounded to zero.
    rounded = round(value, decimals) + 0.0
    text = f"{rounded:+.{decimals}f}" if sign else f"{rounded:.{decimals}f}"
    return text.replace("-", MINUS)


def aligned(cells: pd.DataFrame) -> list[str]:
    """Return the alignment of each column: ``r`` for numbers, ``l`` otherwise."""
    columns = ([str(text) for text in cells.iloc[:, k]] for k in range(cells.shape[1]))
    known = ([text for text in texts if text not in ("", NOTHING)] for texts in columns)
    return ["r" if texts and all(map(_NUMBER.match, texts)) else "l" for texts in known]


_NUMBER = re.compile(rf"\[?[+{MINUS}]?\d[\d.,]*(e[-+]?\d+)?(?![\d.,A-Za-z_])")
"""Pattern of cells with numbers: a share of runs, an interval, a mean with its spread, a unit."""


def mean_and_std(summary: Summary, decimals: int = 2) -> str:
    """Format a mean with its standard deviation, omitted for a single number."""
    mean = number(summary.mean, decimals)
    return mean if summary.count < 2 else f"{mean} ± {number(summary.std, decimals)}"


def write_table(table: Table, folder: Path, origin: Mapping[str, Any]) -> None:
    """Write LaTeX, Markdown and CSV files, with a JSON file of the provenance.

    Args:
        table: The table.
        folder: Folder of tables.
        origin: Origin of the table, see :func:`plab.report.writing.origin`; ``footer`` is a list of lines
            for the files themselves.
    """
    path = folder / table.file
    path.parent.mkdir(parents=True, exist_ok=True)
    footer = [str(line) for line in origin["footer"]]
    files = {
        ".tex": "".join(f"% {line}\n" for line in footer) + _latex(table),
        ".md": _markdown(table, footer),
        ".csv": "".join(f"# {line}\n" for line in footer)
        + table.data.to_csv(index=False, lineterminator="\n"),
        ".json": json.dumps({"title": table.title, "notes": table.notes, **origin}, indent=1) + "\n",
    }
    for suffix, text in files.items():
        path.with_suffix(suffix).write_text(text, encoding="utf-8", newline="\n")


def write_index(tables: list[Table], folder: Path) -> None:
    """Write ``tables.tex``, a document with all of them, and ``tables.md``."""
    inputs = "\n".join(f"\\input{{{table.file.as_posix()}.tex}}" for table in tables)
    (folder / "tables.tex").write_text(_DOCUMENT.replace("INPUTS", inputs), encoding="utf-8", newline="\n")
    text = "\n".join((folder / table.file).with_suffix(".md").read_text(encoding="utf-8") for table in tables)
    (folder / "tables.md").write_text(text, encoding="utf-8", newline="\n")


_DOCUMENT = r"""% pdflatex tables.tex, twice: long tables align their columns the second time.
\documentclass{article}
\usepackage[utf8]{inputenc}
\usepackage[a4paper, margin=1.5cm]{geometry}
\usepackage{booktabs}
\usepackage{graphicx}
\usepackage{longtable}
\begin{document}
INPUTS
\end{document}
"""

_LATEX_SIGNS = {"±": r"$\pm$", MINUS: "$-$", NOTHING: "--"}
"""Symbols that need LaTeX commands."""


_COLUMN = {"remark": r"p{0.55\linewidth}"}
"""Columns of running text; all others have their natural width."""


def _latex_text(text: str) -> str:
    for sign in "&%$#_{}":
        text = text.replace(sign, f"\\{sign}")
    for sign, replacement in _LATEX_SIGNS.items():
        text = text.replace(sign, replacement)
    return text


def _latex(table: Table) -> str:
    """Return a table environment for ``\\input``, which needs booktabs, graphicx, longtable.

    A table wider than the page is scaled down, or set in a smaller font if it is long.
    """
    cells = table.cells.map(_latex_text).rename(columns=_latex_text)
    style = cells.style.hide(axis="index")
    if table.bold is not None:
        weights = np.where(table.bold, "font-weight: bold", "")
        style = style.apply(lambda _: pd.DataFrame(weights, cells.index, cells.columns), axis=None)
    size = r"\footnotesize" if len(cells) > 15 or len(cells.columns) > 6 else r"\small"
    caption = _latex_text(" ".join([f"{table.title}.", *table.notes]))
    text = style.to_latex(
        column_format="".join(map(_COLUMN.get, table.cells.columns, aligned(table.cells))),
        hrules=True,
        convert_css=True,
        caption=caption,
        label=f"tab:{table.form}-{table.name}".replace("_", "-"),
        environment="longtable" if table.long else "table",
        position=None if table.long else "htbp",
        position_float=None if table.long else "centering",
    )
    if table.long:
        # Later pages have no caption.
        text = re.sub(r"\\caption\[\].*\n", "", text)
        if _characters(table) > _WIDEST:
            size = r"\tiny\setlength{\tabcolsep}{3pt}"
        return f"{{{size}\n{text}}}\n"
    text = text.replace("\\centering\n", f"\\centering\n{size}\n", 1)
    fitted = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%" + "\n"
    text = text.replace(r"\begin{tabular}", fitted + r"\begin{tabular}", 1)
    return text.replace(r"\end{tabular}", r"\end{tabular}}", 1)


_WIDEST = 115
"""Number of characters per row, with three per gap, that fit on a page in footnote size."""


def _characters(table: Table) -> int:
    widths = [
        0 if name in _COLUMN else max(map(len, [str(name), *table.cells[name].astype(str)]))
        for name in table.cells
    ]
    running = sum(name in _COLUMN for name in table.cells)
    return sum(widths) + 3 * len(widths) + 65 * running


_RULES = {"l": "---", "r": "---:"}


def _markdown(table: Table, footer: list[str]) -> str:
    cells = table.cells.to_numpy(dtype=str)
    if table.bold is not None:
        cells = np.where(table.bold, np.char.add(np.char.add("**", cells), "**"), cells)
    lines = [list(table.cells.columns), [_RULES[side] for side in aligned(table.cells)], *cells.tolist()]
    body = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    notes = f"\n{' '.join(table.notes)}\n" if table.notes else ""
    made = "".join(f"<sub>{line}</sub>  \n" for line in footer)
    return f"## {table.title}\n\n{body}{notes}\n{made}"
