"""The paper's timing table beside ours: the ten tasks, forward and forward with gradient."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path

import pandas as pd

from plab.bench.workload import GRADIENT, REWARD, build, time_calls
from plab.cli.tables import markdown, progress
from plab.config import load_config

__all__ = ["COLUMNS", "paper_table", "rows", "write_markdown"]

COLUMNS = (
    "task", "device", "precision", "batch", "forward_ms", "forward_paper_ms", "forward_ratio", "gradient_ms",
    "gradient_paper_ms", "gradient_ratio",
)  # fmt: skip

DECIMALS = 2

HEADING = """\
# Time per environment step

Milliseconds per environment step and environment, measured with `python -m plab.bench.speed --paper`, beside
what the PlasticineLab paper gives for a GTX 1080 Ti, and the paper's divided by ours. The forward pass
includes loss and reward.

"""


def paper_table() -> pd.DataFrame:
    """Return the paper's milliseconds per environment step, by task."""
    with (files("plab") / "report" / "paper" / "timing.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file, comment="#").set_index("task")


def rows(
    tasks: Sequence[str], overrides: Sequence[str], batch: int, steps: int, repeats: int
) -> Iterator[dict[str, object]]:
    """Measure the tasks of the paper's table.

    Args:
        tasks: Names of tasks.
        overrides: Configuration overrides.
        batch: Number of environments.
        steps: Environment steps per rollout.
        repeats: Timed rollouts.

    Yields:
        A row per task: milliseconds per environment step of one environment, ours, the paper's, and how many
        times ours go into the paper's. The forward pass includes loss and reward.
    """
    paper = paper_table()
    for task in tasks:
        cfg = load_config([*overrides, f"task={task}"])
        progress(f"{task} on {cfg.sim.device}")
        load = build(cfg, batch, steps)
        row: dict[str, object] = {
            "task": cfg.task.name,
            "device": cfg.sim.device,
            "precision": cfg.sim.precision,
            "batch": batch,
        }
        kinds = (("forward", REWARD), ("gradient", GRADIENT))
        for name, kind in kinds:
            timing = time_calls(load.call(kind), repeats)
            ms = float(timing.ms(steps)[0]) / batch
            theirs = float(paper.loc[cfg.task.name, _PAPER[name]])
            row[f"{name}_ms"] = round(ms, DECIMALS)
            row[f"{name}_paper_ms"] = theirs
            row[f"{name}_ratio"] = round(theirs / ms, 1)
        del load
        yield row


_PAPER = {"forward": "forward_ms", "gradient": "forward_backward_ms"}


def write_markdown(path: Path, table: Sequence[Mapping[str, object]]) -> None:
    """Write the rows as a table for the documentation.

    Args:
        path: File to write.
        table: Rows.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(HEADING + markdown(COLUMNS, table), encoding="utf-8")
