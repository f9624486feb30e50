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
# # Reproduction
#
# plab's scores compared with those of Huang et al. (PlasticineLab, ICLR 2021): normalised incremental IoU of
# the final evaluation, in the hard contact model. Ours are read from result files, the paper's from
# `src/plab/report/paper/`.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this

# %%
from plab.report.figures import Drawing, aggregates, legend, rewards, single, style
from plab.report.methods import method
from plab.report.notebook_cells import find_runs, show_figure, show_origin, show_table
from plab.report.statistics import load_series
from plab.report.tables import (
    TOLERANCE,
    agreement,
    iou_tables,
    ordered_tasks,
    solvability,
)

# %%
runs = find_runs(RESULTS, WORDS)
show_origin(runs, COMMAND)

# %% [markdown]
# ## Scores
#
# Mean ± standard deviation over variants and seeds. Numbers in brackets are the available and the expected
# runs of incomplete cells.

# %%
ours, compared = iou_tables(runs, "task")
show_table(ours)

# %% [markdown]
# ## Agreement

# %%
for table in agreement(runs):
    show_table(table)

# %% [markdown]
# ## Differences


# %%
def draw_differences(runs):
    """Plot the differences per task and method with their intervals; None without differences."""
    judged = iou_tables(runs, "task")[-1].data.dropna(subset=["difference"])
    if judged.empty:
        return None
    tasks = [task for task in ordered_tasks(runs.tasks) if task in set(judged["task"])]
    methods = [name for name in runs.methods if name in set(judged["method"])]
    rows = len(tasks) * (len(methods) + 1)
    figure, panel = single(width=6.4, height=0.16 * rows + 0.5)
    panel.axvspan(-TOLERANCE, TOLERANCE, color="#EDEDED", zorder=0)
    panel.axvline(0.0, color="#555555", linewidth=0.8)
    for row in judged.to_dict("records"):
        look = method(row["method"])
        y = tasks.index(row["task"]) * (len(methods) + 1) + methods.index(row["method"])
        reach = [[row["difference"] - row["low"]], [row["high"] - row["difference"]]]
        bars = None if row["low"] != row["low"] else reach
        inside = look.colour if row["runs"] >= row["expected"] else "white"
        dots = {"fmt": "o", "markersize": 4, "capsize": 2, "markerfacecolor": inside, "label": look.label}
        panel.errorbar(row["difference"], y, xerr=bars, color=look.colour, **dots)
    middle = (len(methods) - 1) / 2
    panel.set_yticks([place * (len(methods) + 1) + middle for place in range(len(tasks))], tasks)
    panel.set(ylim=(rows - 1.5, -1.0), xlabel="score, plab minus the paper")
    panel.grid(axis="y", visible=False)
    legend(figure)
    notes = [
        "Points: differences of mean scores; bars: 95 % intervals; open: runs are missing; grey: within "
        f"{TOLERANCE:g}, about what the paper's runs differ by."
    ]
    return Drawing("differences", figure, notes)


with style():
    drawing = draw_differences(runs)
show_figure(drawing)

# %% [markdown]
# ## Every configuration

# %%
every = iou_tables(runs, "configuration")[-1]
show_table(every.cells[every.data["runs"] > 0], every.notes)

# %% [markdown]
# ## Learning curves and the suite as a whole

# %%
if len(runs.table):
    with style():
        drawings = [rewards(runs, load_series(runs))[0], *aggregates(runs)]
    for drawing in drawings:
        show_figure(drawing)
else:
    show_figure(None)

# %% [markdown]
# ## Solvability
#
# Our targets are generated from parameters or scripts, the paper's are files, so the goals differ slightly.
# The demonstrations show the achievable scores for our targets: if a method scores less, the method is the
# limit, not the task.

# %%
show_table(*solvability(runs))

# %% [markdown]
# ## The paper's numbers

# %%
show_table(compared)
