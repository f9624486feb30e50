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
# plab's scores beside those that Huang et al. print (PlasticineLab, ICLR 2021): normalised incremental IoU
# of the final evaluation, in the hard contact model. Ours come from result files alone, the paper's
# from `src/plab/report/paper/`.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this

# %%
from plab.report.curves import aggregates, rewards
from plab.report.figures import style
from plab.report.notebook import gather, say, show_figure, show_origin, show_table
from plab.report.series import load_series
from plab.report.tables import iou_per_task, settings_note, solvability
from plab.report.verdicts import RULE, VERDICTS, differences, verdict_grid, verdicts

runs = gather(RESULTS, WORDS)
show_origin(runs, COMMAND)

# %% [markdown]
# ## What there is
#
# Mean ± standard deviation over variants and seeds. A number in brackets says how many of the expected
# runs a cell holds.

# %%
ours, paper, compared = iou_per_task(runs)
show_table(ours)

# %% [markdown]
# ## Verdicts
#
# One rule for all cells.

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
with style():
    drawing = differences(runs)
show_figure(drawing)

# %% [markdown]
# ## Every configuration
#
# Three seeds on each side make wide intervals, so that many configurations stay undecided which are
# decided per task.

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
# ## What can be reached
#
# Our targets are made from their parameters or by scripts, the paper's are files, so the two judge
# somewhat different goals. The demonstrations show what is possible with ours: where a method stays below
# its demonstration, the method is what falls short, not the task.

# %%
show_table(solvability(runs)[2])

# %% [markdown]
# ## The paper's numbers

# %%
show_table(paper)
show_table(compared)
