"""Agreement of scores with the paper's, over all configurations."""

from __future__ import annotations

import numpy as np
import pandas as pd

from plab.report.collect import Runs
from plab.report.formats import Table, number
from plab.report.methods import method
from plab.report.tables import iou_per_configuration

TOLERANCE = 0.1
"""Differences of scores up to this count as none: about what the paper's own runs of one configuration differ
by (its standard deviations are 0.09 in the mean)."""

AGREES = f"within two of the paper's standard deviations or {TOLERANCE:g} of its mean"
"""Criterion for the agreement of a cell."""


def compared_cells(runs: Runs) -> pd.DataFrame:
    """Return the cells that both have, a row per task, variant and method.

    Returns:
        Columns task, variant, method, ours, paper, paper_std (of the population), runs, difference (ours
        minus the paper's) and agrees (whether that is within two standard deviations or the tolerance).
    """
    data = iou_per_configuration(runs)[-1].data
    data = data[(data["runs"] > 0) & data["paper_mean"].notna()]
    cells = data[["task", "variant", "method"]].assign(
        ours=data["mean"], paper=data["paper_mean"], paper_std=data["paper_std"], runs=data["runs"]
    )
    apart = cells["ours"] - cells["paper"]
    allowed = np.maximum(2.0 * cells["paper_std"], TOLERANCE)
    return cells.assign(difference=apart, agrees=apart.abs() <= allowed).reset_index(drop=True)


def agreement(runs: Runs) -> list[Table]:
    """Return the agreement per method, per kind of method if there are both, and over all of them; nothing
    where no cell is in both."""
    cells = compared_cells(runs)
    if cells.empty:
        return []
    groups = [(method(name).label, own) for name, own in cells.groupby("method", sort=False)]
    kinds = [
        (f"all {kind}", own) for kind, own in cells.groupby(cells["method"].map(lambda n: method(n).kind))
    ]
    groups += kinds if len(kinds) > 1 else []
    data = pd.DataFrame([{"method": label} | in_all(own) for label, own in [*groups, ("all", cells)]])
    shown = pd.DataFrame(
        {
            "method": data["method"],
            "cells": data["cells"].map(str),
            "correlation": data["correlation"].map(number),
            "mean distance": data["distance"].map(number),
            "mean difference": [number(value, sign=True) for value in data["difference"]],
            "agree": [f"{number(100.0 * share, 0)} %" for share in data["agree"]],
        }
    )
    notes = [
        "Mean scores of the configurations that both have. Correlation: Pearson's. Distance: of the means, "
        f"without sign; difference: ours minus the paper's. Agree: {AGREES}."
    ]
    return [Table("agreement", "comparison", "Agreement with the paper's table", shown, data, notes=notes)]


def in_all(cells: pd.DataFrame) -> dict[str, float]:
    """Return the agreement of some of the :func:`compared_cells` as a whole.

    Returns:
        Their number ``cells``, ``correlation`` (NaN where nothing varies), mean ``distance``, mean
        ``difference``, and the share that ``agree``.
    """
    varied = len(cells) > 1 and cells["ours"].std() > 0.0 and cells["paper"].std() > 0.0
    return {
        "cells": len(cells),
        "correlation": cells["ours"].corr(cells["paper"]) if varied else float("nan"),
        "distance": cells["difference"].abs().mean(),
        "difference": cells["difference"].mean(),
        "agree": cells["agrees"].mean(),
    }
