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
# One result file in detail: configuration, iterations and evaluation, by default of the run with the highest
# score.

# %% tags=["parameters"]
RESULTS = ["results"]  # folders or archives; "example" is the archive that comes with plab
WORDS = []  # which runs: ["task=Move", "seed=0,1,2"]
BENCH = "reports/bench"  # folder of the benchmarks' CSV files; "example" has those that come with plab
COMMAND = "Jupyter"  # what is given as the command that made this
RUN = None  # a result file; None: the run with the highest score

# %%
import itertools
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from IPython.display import HTML, Image, display

from plab.render import RenderError, require_graphics
from plab.report.collect import changed_settings
from plab.report.figures import PHASES, Drawing, grid, legend, single, style
from plab.report.methods import method
from plab.report.notebook_cells import gather, say, show_figure, show_table
from plab.results import read
from plab.results.run_file import loss_columns

if RUN is None:
    table = gather(RESULTS, WORDS).table.sort_values(["score", "config_hash"], ascending=[False, True])
    RUN = table["path"].iloc[0] if len(table) else None
run = None if RUN is None else read(RUN)
if run is not None:
    say(f"Made by `{COMMAND}` from `{run.path}`; SHA-256 of its configuration `{run.config_hash}`.")

# %% [markdown]
# ## Configuration

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
# Okabe and Ito's palette, suitable for all types of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")


def draw_loss_terms(run):
    """Draw the terms of the trajectory loss, weighted as the run weights them."""
    weights = run.config["method"]["loss_weights"]
    table = run.iterations
    figure, panel = single(width=6.4, height=2.4)
    panel.plot(table["episodes"] + 1, table["loss"], color="black", label="loss")
    columns = loss_columns(run.config)
    for column, colour in zip(columns, itertools.cycle(COLOURS), strict=False):
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


if run is not None:
    with style():
        drawing = draw_loss_terms(run)
    show_figure(drawing)

# %% [markdown]
# ## Reward, score, IoU


# %%
def draw_measures(run):
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


if run is not None:
    with style():
        drawing = draw_measures(run)
    show_figure(drawing)

# %% [markdown]
# ## Best actions


# %%
def draw_actions(run):
    """Draw the best actions, a row per component and a column per environment step."""
    names = list(run.config["task"]["manipulators"])
    figure, panel = single(width=6.4, height=0.2 * run.best_actions.shape[1] + 0.5)
    look = {"vmin": -1, "vmax": 1, "cmap": "PuOr", "aspect": "auto"}
    image = panel.imshow(np.clip(run.best_actions, -1, 1).T, interpolation="nearest", **look)
    count = run.best_actions.shape[1]
    panel.set_yticks(range(count), [str(k) for k in range(count)], fontsize=6)
    panel.set(xlabel="environment step", ylabel="component")
    panel.grid(visible=False)
    figure.colorbar(image, ax=panel, pad=0.01, label="action")
    return Drawing(
        "actions", figure, [f"Best actions; manipulators in the order of the components: {', '.join(names)}."]
    )


if run is not None and run.best_actions is not None:
    with style():
        drawing = draw_actions(run)
    show_figure(drawing)

# %% [markdown]
# ## Effect of the actions

# %%
if run is not None and run.best_actions is not None:
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "strip.png"
        try:
            require_graphics()
            from plab.render.pictures import draw_strip

            draw_strip(run.path, picture)
            display(Image(picture.read_bytes(), width=1000, alt="start, target and end"))
        except RenderError as error:
            say(f"No pictures: {error}")

# %% [markdown]
# ## Time


# %%
def draw_times(run):
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


if run is not None:
    with style():
        drawing = draw_times(run)
    show_figure(drawing)

# %% [markdown]
# ## Evaluation and origin


# %%
def facts(run):
    """Return where a run comes from and what it reached, a row per fact."""
    known = {f"evaluation: {name}": f"{value:.4g}" for name, value in run.evaluation.items()}
    known |= {"protocol": run.config["protocol"]["name"]}
    known |= {name: str(value) for name, value in run.provenance.items()}
    return pd.DataFrame({"what": known.keys(), "value": known.values()})


show_table(pd.DataFrame() if run is None else facts(run))
