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
import math

from plab.report.curves import aggregates, rewards
from plab.report.figures import Drawing, legend_of_methods, single, style
from plab.report.formats import number
from plab.report.methods import method
from plab.report.notebook_cells import gather, say, show_figure, show_origin, show_table
from plab.report.series import load_series
from plab.report.tables import (
    TOLERANCE,
    iou_per_configuration,
    iou_per_task,
    ordered_tasks,
    settings_note,
    solvability,
)

# %%
runs = gather(RESULTS, WORDS)
show_origin(runs, COMMAND)

# %% [markdown]
# ## Scores
#
# Mean ± standard deviation over variants and seeds. Numbers in brackets are the available and the expected
# runs of incomplete cells.

# %%
ours, paper, compared = iou_per_task(runs)
show_table(ours)

# %% [markdown]
# ## Verdicts
#
# The same rule applies to all cells.

# %%
VERDICTS = {
    "same": f"the whole interval lies within ±{TOLERANCE:g}",
    "higher": f"the whole interval lies above zero, and not within ±{TOLERANCE:g}",
    "lower": f"the whole interval lies below zero, and not within ±{TOLERANCE:g}",
    "undecided": f"the interval holds zero and reaches beyond ±{TOLERANCE:g}: more runs would tell",
    "too few runs": "no interval: a variant has a single run",
    "no runs": "nothing to judge",
}
"""Verdicts, and when they are given."""

RULE = (
    "The difference is plab minus the paper, with its 95 % interval (Welch's t within each variant), widened "
    "by the ±0.005 to which the paper rounds. "
    + "; ".join(f"**{name}**: {when}" for name, when in VERDICTS.items())
    + ". Where variants or seeds are missing, the verdict is about those that are there, and the count says "
    "so."
)
"""The rule, in Markdown."""

_ROUNDING = 0.005


def verdict(row):
    """Judge a cell.

    Args:
        row: ``runs``, ``difference``, ``low`` and ``high`` of the table of comparison.

    Returns:
        A key of :data:`VERDICTS`.
    """
    if not row["runs"] or math.isnan(row["difference"]):
        return "no runs"
    if math.isnan(row["low"]):
        return "too few runs"
    low, high = row["low"] - _ROUNDING, row["high"] + _ROUNDING
    # Equivalence comes first: with enough runs the smallest difference is one.
    if -TOLERANCE <= low and high <= TOLERANCE:
        return "same"
    if low > 0:
        return "higher"
    return "lower" if high < 0 else "undecided"


def verdicts(runs, *, configurations=False):
    """Return the table of comparison, per task or per configuration, with a column ``verdict``.

    Args:
        runs: Our runs.
        configurations: Whether to judge every variant for itself.
    """
    comparison = (iou_per_configuration if configurations else iou_per_task)(runs)[-1].data
    judged = [verdict(row) for row in comparison.to_dict("records")]
    return comparison.assign(verdict=judged)


def verdict_grid(judged):
    """Return the verdicts as text, a row per task or configuration and a column per method."""
    keys = [name for name in ("task", "variant") if name in judged]
    text = [_judged(row) for row in judged.to_dict("records")]
    shown = judged.assign(text=text, method=[method(name).label for name in judged["method"]])
    wide = shown.pivot(index=keys, columns="method", values="text")
    order = shown[keys].drop_duplicates().itertuples(index=False, name=None)
    index = [key if len(keys) > 1 else key[0] for key in order]
    return wide.loc[index, list(dict.fromkeys(shown["method"]))].rename_axis(columns=None).reset_index()


def _judged(row):
    if row["verdict"] == "no runs":
        return "no runs"
    count = "" if row["runs"] >= row["expected"] else f" ({row['runs']}/{row['expected']})"
    return f"{row['verdict']} {number(row['difference'], sign=True)}{count}"


# %%
say(RULE)

# %%
per_task = verdicts(runs)
counts = per_task["verdict"].value_counts()
say("Of the cells per task: " + ", ".join(f"{counts.get(name, 0)} {name}" for name in VERDICTS) + ".")
show_table(verdict_grid(per_task), settings_note(runs))

# %% [markdown]
# ## Differences


# %%
def draw_differences(runs):
    """Draw the differences per task and method with their intervals; None without any."""
    judged = verdicts(runs)
    judged = judged[judged["verdict"] != "no runs"]
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
        bars = None if math.isnan(row["low"]) else reach
        inside = look.colour if row["runs"] >= row["expected"] else "white"
        dots = {"fmt": "o", "markersize": 4, "capsize": 2, "markerfacecolor": inside}
        panel.errorbar(row["difference"], y, xerr=bars, color=look.colour, **dots)
    middle = (len(methods) - 1) / 2
    panel.set_yticks([place * (len(methods) + 1) + middle for place in range(len(tasks))], tasks)
    panel.set(ylim=(rows - 1.5, -1.0), xlabel="score, plab minus the paper")
    panel.grid(axis="y", visible=False)
    legend_of_methods(figure, methods)
    notes = ["Points: differences of mean scores; bars: 95 % intervals; open: runs are missing."]
    return Drawing("differences", figure, notes)


with style():
    drawing = draw_differences(runs)
show_figure(drawing)

# %% [markdown]
# ## Every configuration
#
# With three seeds on each side intervals are wide, so many configurations are undecided although their task
# is not.

# %%
per_configuration = verdicts(runs, configurations=True)
present = per_configuration[per_configuration["verdict"] != "no runs"]
counts = present["verdict"].value_counts()
if len(present):
    say(
        "Of the configurations and methods with runs: "
        + ", ".join(f"{count} {name}" for name, count in counts.items())
        + "."
    )
    tasks = set(present["task"])
    show_table(verdict_grid(per_configuration[per_configuration["task"].isin(tasks)]))
else:
    say("*There are none with runs.*")

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
show_table(solvability(runs)[2])

# %% [markdown]
# ## The paper's numbers

# %%
show_table(paper)
show_table(compared)
