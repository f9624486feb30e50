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
# Time per environment step beside the paper's, from the benchmark where its file is there, and from the
# runs themselves.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this

# %%
from plab.report.costs import phases, step_times
from plab.report.figures import style
from plab.report.measurements import SPEED
from plab.report.notebook import benchmark, gather, say, show_figure, show_origin, show_table
from plab.report.times import timing

runs = gather(RESULTS, WORDS)
show_origin(runs, COMMAND)
speed = benchmark(BENCH, SPEED)

# %% [markdown]
# ## Time per environment step

# %%
ours, paper, compared = timing(runs, speed)
show_table(compared)

# %%
with style():
    drawing = step_times(compared.data)
show_figure(drawing)

# %% [markdown]
# Runs that share a simulator share its time, so that a run's step takes less time the more runs there are:
# that is how much a sweep costs, not how long one waits for a step. The benchmark's rows with batch 1 say
# that.

# %%
show_table(ours)

# %% [markdown]
# ## Where the time of a run goes

# %%
with style():
    drawing = phases(runs)
show_figure(drawing)

# %%
if len(runs.table):
    total = runs.table["seconds"].sum()
    devices = ", ".join(sorted(set(runs.table["device"])))
    say(f"All {len(runs.table)} runs together took {total / 60:.1f} minutes on: {devices}.")
