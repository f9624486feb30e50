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
# # Anatomy of a run
#
# One result file: what was run, what happened, what came out. It is the run with the highest score, unless
# one is named.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this
RUN = None  # a result file; None: the run with the highest score

# %%
import tempfile
from pathlib import Path

import pandas as pd
import yaml
from IPython.display import HTML, Image, display

from plab.render import RenderError, require_graphics
from plab.report import anatomy
from plab.report.collect import changed_settings
from plab.report.figures import style
from plab.report.notebook import gather, say, show_figure, show_table
from plab.results import read

if RUN is None:
    table = gather(RESULTS, WORDS).table.sort_values(["score", "config_hash"], ascending=[False, True])
    RUN = table["path"].iloc[0] if len(table) else None
run = None if RUN is None else read(RUN)
if run is not None:
    say(f"Made by `{COMMAND}` from `{run.path}`; SHA-256 of its configuration `{run.config_hash}`.")

# %% [markdown]
# ## What was run

# %%
if run is not None:
    config = run.config
    say(
        f"{config['task']['name']}, variant {config['variant']}, {config['method']['name']}, seed "
        f"{config['seed']}: {run.status}, {len(run.iterations)} rows; the best is row {run.best_iteration}."
    )
    changed = changed_settings(config)
    say(
        "Settings other than plab's own: "
        + (", ".join(f"`{k}={v}`" for k, v in changed.items()) or "none")
        + "."
    )
    for section in ("method", "sim", "task"):
        text = yaml.safe_dump(config[section], sort_keys=False, default_flow_style=None)
        display(HTML(f"<details><summary>{section}</summary><pre>{text}</pre></details>"))

# %% [markdown]
# ## Loss

# %%
if run is not None:
    with style():
        drawing = anatomy.loss_terms(run)
    show_figure(drawing)

# %% [markdown]
# ## Reward, score, IoU

# %%
if run is not None:
    with style():
        drawing = anatomy.measures(run)
    show_figure(drawing)

# %% [markdown]
# ## Best actions

# %%
if run is not None and run.best_actions is not None:
    with style():
        drawing = anatomy.actions(run)
    show_figure(drawing)

# %% [markdown]
# ## What they do

# %%
if run is not None and run.best_actions is not None:
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "strip.png"
        try:
            require_graphics()
            from plab.render.replays import draw_strip

            draw_strip(run.path, picture)
            display(Image(picture.read_bytes(), width=1000, alt="start, target and end"))
        except RenderError as error:
            say(f"No pictures: {error}")

# %% [markdown]
# ## Time

# %%
if run is not None:
    with style():
        drawing = anatomy.times(run)
    show_figure(drawing)

# %% [markdown]
# ## Evaluation and origin

# %%
show_table(pd.DataFrame() if run is None else anatomy.facts(run))
