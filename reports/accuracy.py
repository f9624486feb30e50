# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Accuracy
#
# Errors relative to much finer simulations, and the effect of the contact model.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this

# %%
import numpy as np
import pandas as pd

from plab.report.figures import Drawing, diagrams, legend, single, style
from plab.report.methods import method
from plab.report.notebook_cells import benchmark, find_runs, show_figure, show_origin, show_table
from plab.report.reference import ACCURACY
from plab.report.statistics import load_series
from plab.report.tables import number

runs = find_runs(RESULTS, WORDS)
show_origin(runs, COMMAND)

# %% [markdown]
# ## Run time against error

# %%
table = benchmark(BENCH, ACCURACY)
if table is not None:
    with style():
        drawings = diagrams(table)
    for drawing in drawings:
        show_figure(drawing)

# %% [markdown]
# ## Soft and hard contact
#
# Gradient methods optimise actions in the contact model of their rollouts (soft, except for Adam-H) and are
# evaluated in the hard one. Points below the line lose score in hard contact.


# %%
def draw_contact_models(runs, series):
    """Plot the score of each run's best row against that of its final evaluation; None without runs.

    Gradient methods optimise actions in the contact model of their rollouts (soft, except for Adam-H) and are
    evaluated in the hard one.

    Args:
        runs: Our runs.
        series: Rows of the runs, in the order of ``runs.table``.
    """
    if runs.table.empty:
        return None
    figure, panel = single(width=3.6, height=3.1)
    panel.plot([0, 1], [0, 1], color="#999999", linewidth=0.8)
    gaps = {name: [] for name in runs.methods}
    for row, (_, rows) in zip(runs.table.to_dict("records"), series, strict=True):
        best = rows["score"][rows["iteration"] == row["best_iteration"]]
        if len(best):
            before = min(max(float(best[0]), 0.0), 1.0)
            look = method(row["method"])
            dots = {"color": look.colour, "label": look.label, "markersize": 3.5, "alpha": 0.8}
            panel.plot(before, row["score_best"], "o", **dots)
            gaps[row["method"]].append(row["score_best"] - before)
    panel.set(
        xlim=(-0.02, 1.02),
        ylim=(-0.02, 1.02),
        xlabel="score of the best row, in its own contact model",
        ylabel="score of the final evaluation, hard contact",
    )
    legend(figure)
    numbers = {
        name: {"runs": len(own), "mean": float(np.mean(own)), "largest": float(max(own, key=abs))}
        for name, own in gaps.items()
        if own
    }
    return Drawing("contact_models", figure, ["A point per run."], numbers)


with style():
    drawing = draw_contact_models(runs, load_series(runs))
show_figure(drawing)

# %%
if drawing is not None:
    rows = [
        {"method": method(name).label, "runs": own["runs"]}
        | {"mean change": number(own["mean"], 3, sign=True), "largest": number(own["largest"], 3, sign=True)}
        for name, own in drawing.numbers.items()
    ]
    show_table(pd.DataFrame(rows))
