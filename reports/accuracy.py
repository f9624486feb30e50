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
# How far results are from those of much finer simulations, what single precision changes, and what the
# contact model changes.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this

# %%
import pandas as pd

from plab.report.costs import contact_models, precision_summary, work_precision
from plab.report.figures import style
from plab.report.measurements import ACCURACY, PRECISION, origin
from plab.report.methods import method
from plab.report.notebook import benchmark, gather, show_figure, show_origin, show_table
from plab.report.series import load_series
from plab.report.table import number

runs = gather(RESULTS, WORDS)
show_origin(runs, COMMAND)

# %% [markdown]
# ## Run time against error

# %%
table = benchmark(BENCH, ACCURACY)
if table is not None:
    with style():
        drawing = work_precision(table)
    show_figure(drawing)

# %% [markdown]
# ## float32 against float64

# %%
table = benchmark(BENCH, PRECISION)
if table is not None:
    show_table(precision_summary(table), origin(table))

# %% [markdown]
# ## Soft and hard contact
#
# Gradient methods find their actions in the contact model of their rollouts (soft, but for Adam-H) and are
# judged in the hard one. Below the line: what was won in the one is lost in the other.

# %%
with style():
    drawing = contact_models(runs, load_series(runs))
show_figure(drawing)

# %%
if drawing is not None:
    rows = [
        {"method": method(name).label, "runs": own["runs"]}
        | {"mean change": number(own["mean"], 3, sign=True), "largest": number(own["largest"], 3, sign=True)}
        for name, own in drawing.numbers.items()
    ]
    show_table(pd.DataFrame(rows))
