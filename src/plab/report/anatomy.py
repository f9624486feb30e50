"""One run, looked at closely: its loss, its measures, its actions, its time."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pandas as pd

from plab.report.costs import PHASES
from plab.report.figures import Drawing, grid, legend, single
from plab.report.methods import method
from plab.results import ResultsError, RunResult
from plab.results.schema import loss_columns

__all__ = ["actions", "facts", "loss_terms", "measures", "times"]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Colours of the terms, in their order; Okabe and Ito's, which people with any colour vision can tell
apart."""


def loss_terms(run: RunResult) -> Drawing:
    """Draw the terms of the trajectory loss, weighted as the run weights them."""
    weights = run.config["method"]["loss_weights"]
    table = run.iterations
    figure, panel = single(width=6.4, height=2.4)
    panel.plot(table["episodes"] + 1, table["loss"], color="black", label="loss")
    columns = loss_columns(run.config)
    for column, colour in zip(columns, itertools.cycle(_COLOURS), strict=False):
        name = column.removeprefix("loss_")
        values = weights[name] * table[column]
        if (values > 0).any():
            label = f"{weights[name]:g} x {name}"
            panel.plot(table["episodes"] + 1, values.where(values > 0), color=colour, label=label)
    best = table[table["iteration"] == run.best_iteration]["episodes"] + 1
    for episode in best:
        panel.axvline(episode, color="#999999", linewidth=0.8, linestyle=":")
    panel.set_yscale("log")
    # Less than this of the loss is as good as nothing.
    panel.set_ylim(bottom=max(panel.get_ylim()[0], 1e-3 * float(table["loss"].min())))
    panel.set(xlabel="episodes", ylabel="summed over the steps")
    legend(figure)
    terms = [
        f"{column.removeprefix('loss_')}: {run.labels[column]}" for column in columns if column in run.labels
    ]
    what = f" Terms: {'; '.join(terms)}." if terms else ""
    return Drawing(
        "loss_terms", figure, [f"Trajectory loss and its weighted terms; dotted: the best row.{what}"]
    )


def measures(run: RunResult) -> Drawing:
    """Draw reward, score, soft IoU and, where there is one, the gradient's norm."""
    table = run.iterations
    columns = {"reward": "reward", "score": "score", "iou": "soft IoU"}
    columns["gradient_norm"] = "norm of the gradient"
    shown = {name: text for name, text in columns.items() if name in table}
    figure, axes = grid(1, len(shown), width=2.2, height=1.8)
    for panel, (name, text) in zip(axes[0], shown.items(), strict=True):
        panel.plot(table["episodes"] + 1, table[name], color=method(run.config["method"]["name"]).colour)
        panel.set(title=text, xlabel="episodes")
        if name == "score":
            panel.axhline(run.evaluation.get("score", np.nan), color="black", linewidth=0.8, linestyle="--")
        if name == "gradient_norm":
            panel.set_yscale("log")
    return Drawing(
        "measures", figure, ["Of each row; dashed: score of the final evaluation, in the hard contact model."]
    )


def actions(run: RunResult) -> Drawing:
    """Draw the best actions, a row per component and a column per environment step."""
    names = list(run.config["task"]["manipulators"])
    if run.best_actions is None:
        raise ResultsError("the run has no actions yet")
    figure, panel = single(width=6.4, height=0.2 * run.best_actions.shape[1] + 0.5)
    look: dict[str, Any] = {"vmin": -1, "vmax": 1, "cmap": "PuOr", "aspect": "auto"}
    image = panel.imshow(np.clip(run.best_actions, -1, 1).T, interpolation="nearest", **look)
    count = run.best_actions.shape[1]
    panel.set_yticks(range(count), [str(k) for k in range(count)], fontsize=6)
    panel.set(xlabel="environment step", ylabel="component")
    panel.grid(visible=False)
    figure.colorbar(image, ax=panel, pad=0.01, label="action")
    return Drawing(
        "actions", figure, [f"Best actions; manipulators in the order of the components: {', '.join(names)}."]
    )


def times(run: RunResult) -> Drawing:
    """Draw the phases of the run, and the time of each row."""
    figure, axes = grid(1, 2, width=3.2, height=1.7)
    bars, rows = axes[0]
    names = [name for name in PHASES if name in run.wall_time]
    bars.barh(
        range(len(names)), [run.wall_time[name] for name in names], color=[PHASES[name] for name in names]
    )
    bars.set_yticks(range(len(names)), names)
    bars.invert_yaxis()
    bars.set_xlabel("seconds")
    rows.plot(run.iterations["iteration"][1:], run.iterations["seconds"][1:], color="#0072B2")
    rows.set(ylim=(0.0, None), xlabel="row", ylabel="seconds")
    batch = run.provenance.get("batch", 1)
    share = f"; the run's share of a batch of {batch}" if batch and batch > 1 else ""
    return Drawing(
        "times",
        figure,
        [f"Wall time by phase and by row{share}. The first row, which compiles, is left out on the right."],
    )


def facts(run: RunResult) -> pd.DataFrame:
    """Return where a run comes from and what it reached, a row per fact."""
    known = {f"evaluation: {name}": f"{value:.4g}" for name, value in run.evaluation.items()}
    known |= {"protocol": run.config["protocol"]["name"]}
    known |= {name: str(value) for name, value in run.provenance.items()}
    return pd.DataFrame({"what": known.keys(), "value": known.values()})
