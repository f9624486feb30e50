"""Figure of scores in unseen scenes for the documentation.

python tools/unseen.py docs/images/unseen.png     from src/plab/results/examples/unseen.csv
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from plab.report.methods import method
from plab.results.examples import measurements

LABELS = {
    "bc": "bc, cloned",
    "nearest neighbour": "nearest neighbour",
    "pods": "pods, trained with gradients",
    "ppo": "ppo, trained with rewards",
    "adam": "adam, plan per scene",
    "solve": "solve, plan per scene",
}

table = pd.read_csv(measurements("example") / "unseen.csv")
tasks = list(table.task.unique())
figure, axes = plt.subplots(figsize=(9.0, 3.4), layout="constrained")
for k, (name, label) in enumerate(LABELS.items()):
    rows = table[table.method == name]
    places = [tasks.index(task) + 0.15 * (k - 2.5) for task in rows.task]
    colour = "#999999" if name == "nearest neighbour" else method(name).colour
    axes.bar(places, rows.score, 0.13, label=label, color=colour)
    errors = np.abs(rows[["lower", "upper"]].to_numpy().T - rows.score.to_numpy())
    axes.errorbar(places, rows.score, errors, fmt="none", ecolor="#333333", elinewidth=1, capsize=2)
axes.set(ylabel="score in unseen scenes", ylim=(0, 1), xlim=(-0.6, len(tasks) - 0.4))
axes.set_xticks(range(len(tasks)), tasks, fontsize=8.5)
axes.spines[["top", "right"]].set_visible(False)
figure.legend(loc="outside upper center", ncols=6, frameon=False, fontsize=7.5, columnspacing=1.0)
figure.savefig(sys.argv[1], dpi=110)
