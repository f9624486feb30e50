"""Logs of runs beside their result files: ``logger=tensorboard``, ``logger=wandb``.

Each row is logged at the environment steps that its actions have cost, under the names of the results'
columns, and the final evaluation under ``final/``.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress

from plab.config import Config
from plab.results import ResultsError, RunFile

PROJECT = "plab"
"""Name of the project at Weights & Biases, unless ``WANDB_PROJECT`` names another."""

Write = Callable[[Mapping[str, float], int], object]
"""Logs finite numbers by name at some environment steps."""


class RunLog:
    """Log of a run, opened at the first numbers, or none."""

    def __init__(self, cfg: Config, run: RunFile) -> None:
        """Keep the run's configuration and file."""
        self._cfg, self._run = cfg, run
        self._logger: tuple[Write, Callable[[], object]] | None = None

    @property
    def wanted(self) -> bool:
        """Return whether the run has a logger."""
        return self._cfg.logger != "none"

    def write(self, values: Mapping[str, float], steps: int) -> None:
        """Log numbers by name at some environment steps, those that are not finite left out; ResultsError
        if that fails."""
        if not self.wanted:
            return
        try:
            if self._logger is None:
                opened = {"tensorboard": _tensorboard, "wandb": _wandb}[self._cfg.logger]
                self._logger = opened(self._cfg, self._run, steps)
            write, _ = self._logger
            write({name: float(value) for name, value in values.items() if math.isfinite(value)}, steps)
        except (OSError, RuntimeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ResultsError(f"logger={self._cfg.logger} fails: {reason}; logger=none goes on") from error

    def close(self) -> None:
        """End the log."""
        if self._logger is not None:
            # All rows have been written; the final evaluation is in the result file.
            with suppress(OSError, RuntimeError):
                self._logger[1]()
            self._logger = None


def _tensorboard(cfg: Config, run: RunFile, steps: int) -> tuple[Write, Callable[[], object]]:
    """Open a TensorBoard event file in the folder ``<name>.tensorboard`` beside the result.

    TensorBoard hides entries of earlier processes after ``steps``.
    """
    # Imported here: it is optional.
    from torch.utils.tensorboard.writer import SummaryWriter

    writer = SummaryWriter(str(run.path.with_suffix(".tensorboard")), purge_step=steps)

    def write(values: Mapping[str, float], steps: int) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, steps)
        # To be seen at once.
        writer.flush()

    return write, writer.close


def _wandb(cfg: Config, run: RunFile, steps: int) -> tuple[Write, Callable[[], object]]:
    """Begin a run at Weights & Biases, or go on with that of the same configuration.

    Its own files are in the folder ``wandb`` of ``results_dir``; ``WANDB_MODE`` and wandb's other variables
    apply.
    """
    # Imported here: it is optional.
    import wandb

    name = f"{cfg.task.name}-v{cfg.variant}-{cfg.method.name}-{run.path.stem}"
    try:
        begun = wandb.init(
            project=os.environ.get("WANDB_PROJECT") or PROJECT,
            name=name,
            # Ids are limited to 128 characters.
            id=re.sub(r"[^\w.-]", "_", name)[:128],
            dir=cfg.results_dir,
            config=run.result.config,
            resume="allow",
            # The runs of a batch are logged side by side.
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
    except wandb.Error as error:
        raise RuntimeError(f"{error} (WANDB_MODE=offline needs no account)") from error
    begun.define_metric("*", step_metric="steps")
    return lambda values, steps: begun.log({**values, "steps": steps}), begun.finish
