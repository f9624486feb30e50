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
# # Speed
#
# Time per environment step compared with the paper's, from the benchmark file if available, and from runs.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this

# %%
import numpy as np

from plab.report.figures import PHASES, Drawing, grid, legend, single, style
from plab.report.methods import method
from plab.report.notebook_cells import benchmark, find_runs, show_figure, show_origin, show_table, show_text
from plab.report.reference import SPEED
from plab.report.tables import ordered_tasks, timing

runs = find_runs(RESULTS, WORDS)
show_origin(runs, COMMAND)
speed = benchmark(BENCH, SPEED)

# %% [markdown]
# ## Time per environment step

# %%
(compared,) = timing(runs, speed)
show_table(compared)


# %%
def draw_step_times(compared):
    """Plot times per environment step next to the paper's; None without any.

    Args:
        compared: Data of the table ``timing`` in the form ``comparison``.
    """
    if compared.empty:
        return None
    tasks = ordered_tasks(list(dict.fromkeys(compared["task"])))
    kinds = [kind for kind in ("forward", "forward + backward") if kind in set(compared["what"])]
    figure, axes = grid(1, len(kinds), width=3.6, height=0.3 * len(tasks) + 0.7)
    markers = dict(zip(dict.fromkeys(compared["measured"]), "osD^vP*X" * 9, strict=False))
    for panel, kind in zip(axes[0], kinds, strict=True):
        for row in compared[compared["what"] == kind].to_dict("records"):
            y = tasks.index(row["task"])
            panel.plot([row["ms"], row["paper_ms"]], [y, y], color="#CCCCCC", zorder=1)
            panel.plot(row["paper_ms"], y, "o", color="white", markeredgecolor="#555555", markersize=5,
                       label="the paper, GTX 1080 Ti", zorder=2)  # fmt: skip
            panel.plot(row["ms"], y, markers[row["measured"]], color="#0072B2", markersize=5,
                       label=f"plab: {row['measured']}", zorder=3)  # fmt: skip
        panel.set(xscale="log", xlabel=f"{kind} [ms per environment step]")
        panel.set_yticks(range(len(tasks)), tasks)
        panel.set_ylim(len(tasks) - 0.5, -0.5)
    legend(figure, columns=1)
    return Drawing("step_times", figure, ["Time of an environment step of one environment."])


with style():
    drawing = draw_step_times(compared.data)
show_figure(drawing)

# %% [markdown]
# Runs that share a simulator share its time, so the time per step decreases with the number of runs. It is
# the cost in a sweep, not the latency of a step, which the rows of the benchmark with batch 1 show.

# %% [markdown]
# ## Where the time of a run goes


# %%
def draw_phases(runs):
    """Plot the mean duration of each phase per task and method; None without runs."""
    names = [name for name in PHASES if f"seconds_{name}" in runs.table]
    if runs.table.empty or not names:
        return None
    columns = [f"seconds_{name}" for name in names]
    means = runs.table.groupby(["task", "method"])[columns].mean()
    keys = [(t, m) for t in ordered_tasks(runs.tasks) for m in runs.methods if (t, m) in means.index]
    figure, panel = single(width=6.4, height=0.24 * len(keys) + 0.6)
    left = np.zeros(len(keys))
    for name, column in zip(names, columns, strict=True):
        values = means.loc[keys, column].fillna(0.0).to_numpy()
        panel.barh(range(len(keys)), values, left=left, color=PHASES[name], label=name, height=0.7)
        left += values
    panel.set_yticks(range(len(keys)), [f"{task}, {method(name).label}" for task, name in keys])
    panel.set(ylim=(len(keys) - 0.5, -0.5), xlabel="seconds of a run")
    panel.grid(axis="y", visible=False)
    legend(figure)
    notes = ["Mean over the runs. Of runs in one batch each one's share of the time."]
    return Drawing("phases", figure, notes)


with style():
    drawing = draw_phases(runs)
show_figure(drawing)

# %%
if len(runs.table):
    total = runs.table["seconds"].sum()
    devices = ", ".join(sorted(set(runs.table["device"])))
    show_text(f"All {len(runs.table)} runs together took {total / 60:.1f} minutes on: {devices}.")
