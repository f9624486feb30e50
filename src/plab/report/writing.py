"""Files of all tables and all figures, with their origin: LaTeX, Markdown, CSV, PDF, PNG."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import plab
from plab.report.collect import Ablation, Runs
from plab.report.statistics import load_rows, load_series
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
    """Write all tables.

    Args:
        runs: Our runs.
        out: Folder to write to.
        command: Command that makes them, for their footers.
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
    from_runs = origin(runs, command, deep=True)
    from_paper = {"command": command, "footer": [f"Made by: {command}"]}
    _write_runs(runs, out)
    for table in tables:
        uses_runs = table.form != "paper" and table.name not in ("solvability", "hyperparameters")
        write_table(table, out, from_runs if uses_runs else from_paper)
    write_index(tables, out)
    return tables


def write_curves(
    runs: Runs, ablation: Ablation | None, out: Path, command: str, errors: pd.DataFrame | None = None
) -> list[Drawing]:
    """Draw all figures with data.

    Args:
        runs: Our runs.
        ablation: Runs that differ in the yield stress, or None.
        out: Folder to write to.
        command: Command that makes them, for their metadata.
        errors: Table of ``plab bench accuracy``, or None.

    Returns:
        The figures.
    """
    # Tables and the page need no Matplotlib.
    from plab.report import figures

    drawings: list[Drawing] = []
    with figures.style():
        if len(runs.table):
            series = load_series(runs)
            drawings += [
                *figures.rewards(runs, series),
                *figures.score_curves(runs, series),
                figures.budget_curves(runs, series),
                *figures.rl_scores(runs),
                *figures.agreement_plot(runs),
                *figures.aggregates(runs),
            ]
        if ablation is not None:
            groups = {value: [load_rows(path) for path in paths] for value, paths in ablation.paths.items()}
            what = f"{ablation.task}-v{ablation.variant}"
            drawings += figures.yield_ablation(groups, what, ablation.method)
        if errors is not None and (drawing := figures.work_precision(errors)) is not None:
            drawings.append(drawing)
        _write_runs(runs, out)
        figures.save(drawings, out, origin(runs, command, deep=False))
    return drawings


def origin(runs: Runs, command: str, *, deep: bool) -> dict[str, Any]:
    """Return the origin of tables or figures; ``deep``: for files in a subfolder."""
    digest = runs.digest
    footer = [f"Made by: {command}", f"From {len(runs.table)} run(s), SHA-256 over them {digest}"]
    return {
        "footer": footer,
        "command": command,
        "plab": plab.__version__,
        "digest": digest,
        **{name: getattr(runs, name) for name in ("unfinished", "others", "set_aside")},
        "unusual": [vars(setting) for setting in runs.unusual],
        "runs": "../runs.json" if deep else "runs.json",
    }


def _write_runs(runs: Runs, out: Path) -> None:
    """Write the list of result files, once for all tables or figures."""
    known = runs.table[["path", "config_hash"]].to_dict("records") if len(runs.table) else []
    replace_file(out / "runs.json", json.dumps(known, indent=1) + "\n")


# ----------------------------------------------------------------------------------------- formats of tables


def write_table(table: Table, folder: Path, origin: Mapping[str, Any]) -> None:
    """Write LaTeX, Markdown and CSV files, with a JSON file of the provenance.

    Args:
        table: The table.
        folder: Folder of tables.
        origin: Origin of the table, see :func:`plab.report.writing.origin`; ``footer`` is a list of lines
            for the files themselves.
    """
    path = folder / table.file
    footer = [str(line) for line in origin["footer"]]
    files = {
        ".tex": "".join(f"% {line}\n" for line in footer) + _latex(table),
        ".md": _markdown(table, footer),
        ".csv": "".join(f"# {line}\n" for line in footer)
        + table.data.to_csv(index=False, lineterminator="\n"),
        ".json": json.dumps({"title": table.title, "notes": table.notes, **origin}, indent=1) + "\n",
    }
    for suffix, text in files.items():
        replace_file(path.with_suffix(suffix), text)


def write_index(tables: list[Table], folder: Path) -> None:
    """Write ``tables.tex``, a document with all of them, and ``tables.md``."""
    inputs = "\n".join(f"\\input{{{table.file.as_posix()}.tex}}" for table in tables)
    replace_file(folder / "tables.tex", _DOCUMENT.replace("INPUTS", inputs))
    text = "\n".join((folder / table.file).with_suffix(".md").read_text(encoding="utf-8") for table in tables)
    replace_file(folder / "tables.md", text)


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
