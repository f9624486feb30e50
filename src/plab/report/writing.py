"""Files of all tables and all figures, with their origin: LaTeX, Markdown, CSV, PDF, PNG."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import plab
from plab.report.collect import Runs
from plab.report.statistics import load_series
from plab.report.tables import (
    MINUS,
    NOTHING,
    Table,
    agreement,
    aligned,
    distances,
    hyperparameters,
    iou_per_configuration,
    iou_per_task,
    score_at_budget,
    solvability,
    timing,
)
from plab.results.run_file import replace_file

if TYPE_CHECKING:
    from plab.report.figures import Drawing


def write_tables(runs: Runs, out: Path, command: str, benchmark: pd.DataFrame | None = None) -> list[Table]:
    """Write all tables as LaTeX and CSV, ``tables.tex`` and ``tables.md`` with all of them, and their origin.

    Args:
        runs: Our runs.
        out: Folder to write to.
        command: Command that generates them.
        benchmark: Table of ``plab bench speed --paper --csv``, or None.

    Returns:
        The tables.
    """
    tables = [
        *iou_per_task(runs),
        *iou_per_configuration(runs),
        *distances(runs),
        *agreement(runs),
        *timing(runs, benchmark),
        *solvability(runs),
        *score_at_budget(runs, load_series(runs)),
        *hyperparameters(),
    ]
    made = _footer(runs, command)
    for table in tables:
        path = out / table.file
        replace_file(path.with_suffix(".tex"), "".join(f"% {line}\n" for line in made) + latex(table))
        numbers = table.data.to_csv(index=False, lineterminator="\n")
        replace_file(path.with_suffix(".csv"), "".join(f"# {line}\n" for line in made) + numbers)
    inputs = "\n".join(f"\\input{{{table.file.as_posix()}.tex}}" for table in tables)
    replace_file(out / "tables.tex", _DOCUMENT.replace("INPUTS", inputs))
    replace_file(out / "tables.md", "\n".join([*map(markdown, tables), *(f"{line}  " for line in made), ""]))
    replace_file(out / "runs.json", json.dumps(origin(runs, command), indent=1) + "\n")
    return tables


def write_curves(runs: Runs, out: Path, command: str) -> list[Drawing]:
    """Draw all figures with data, and write them as PDF and PNG, with their notes and origin.

    Args:
        runs: Our runs.
        out: Folder to write to.
        command: Command that generates them.

    Returns:
        The figures.
    """
    # Tables and the page need no Matplotlib.
    from plab.report import figures

    drawings: list[Drawing] = []
    with figures.style():
        if len(runs.table):
            drawings += [
                *figures.rewards(runs, load_series(runs)),
                *figures.rl_scores(runs),
                *figures.agreement_plot(runs),
                *figures.aggregates(runs),
            ]
        figures.save(drawings, out, " | ".join(_footer(runs, command)))
    replace_file(out / "runs.json", json.dumps(origin(runs, command), indent=1) + "\n")
    return drawings


def origin(runs: Runs, command: str) -> dict[str, Any]:
    """Return the origin of tables, figures or the page: command, version, digest and files of the runs."""
    columns = ["task", "variant", "method", "seed", "config_hash", "path"]
    return {
        "command": command,
        "plab": plab.__version__,
        "digest": runs.digest,
        "left_out": runs.left_out,
        "unusual": runs.unusual,
        "runs": runs.table[columns].to_dict("records") if len(runs.table) else [],
    }


def _footer(runs: Runs, command: str) -> list[str]:
    return [f"Made by: {command}", f"From {len(runs.table)} run(s), SHA-256 over them {runs.digest}"]


# ----------------------------------------------------------------------------------------- formats of tables

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

_LATEX_SIGNS = {"±": r"$\pm$", MINUS: "$-$", NOTHING: "--"} | {sign: f"\\{sign}" for sign in "&%$#_{}"}
_TO_LATEX = str.maketrans(_LATEX_SIGNS)


def latex(table: Table) -> str:
    """Return a table environment for ``\\input``, which needs booktabs, graphicx, longtable; short tables are
    scaled down to the width of the page."""
    cells = table.cells.map(lambda text: text.translate(_TO_LATEX))
    cells = cells.rename(columns=lambda text: text.translate(_TO_LATEX))
    style = cells.style.hide(axis="index")
    if table.bold is not None:
        weights = np.where(table.bold, "font-weight: bold", "")
        style = style.apply(lambda _: weights, axis=None)
    text = style.to_latex(
        column_format="".join(aligned(table.cells)),
        hrules=True,
        convert_css=True,
        caption=" ".join([f"{table.title}.", *table.notes]).translate(_TO_LATEX),
        label=f"tab:{table.form}-{table.name}".replace("_", "-"),
        environment="longtable" if table.long else "table",
        position=None if table.long else "htbp",
        position_float=None if table.long else "centering",
    )
    if table.long:
        # Later pages have no caption.
        text = re.sub(r"\\caption\[\].*\n", "", text)
        size = r"\tiny\setlength{\tabcolsep}{3pt}" if len(cells.columns) > 7 else r"\footnotesize"
        return f"{{{size}\n{text}}}\n"
    fitted = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%" + "\n"
    text = text.replace(r"\begin{tabular}", fitted + r"\begin{tabular}", 1)
    return text.replace(r"\end{tabular}", r"\end{tabular}}", 1)


def markdown(table: Table) -> str:
    """Return a table in Markdown with its title and notes."""
    cells = table.cells.to_numpy(dtype=str)
    if table.bold is not None:
        cells = np.where(table.bold, np.char.add(np.char.add("**", cells), "**"), cells)
    rules = ["---:" if side == "r" else "---" for side in aligned(table.cells)]
    lines = [list(table.cells.columns), rules, *cells.tolist()]
    body = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return f"## {table.title}\n\n{body}\n{' '.join(table.notes)}\n"
