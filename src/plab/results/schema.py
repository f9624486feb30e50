"""Schema of a result file: parts, columns, hash of the configuration, name."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.config.families import FAMILIES
from plab.config.selection import lookup
from plab.errors import PlabError

if TYPE_CHECKING:
    import pandas as pd

SCHEMA_VERSION = 2
"""Version of the file layout; files of another version are not read."""

STATUSES = ("running", "finished", "failed", "stopped")

NAMES = ("task", "variant", "method", "seed")
"""Columns that name a run in tables."""

PARTIAL_SUFFIX = ".partial.h5"
REPLAY_SUFFIX = ".replay"
ARCHIVE_SUFFIX = ".plab.zip.xz"
"""Suffixes of files of runs in progress, of their replay buffers, and of archives."""

_MEASURES = ("loss", "reward", "iou", "score")

BUDGETS = ("steps_forward", "steps_gradient")
"""Columns of the environment steps simulated up to the end of a row, without and with gradient."""

COLUMNS = ("iteration", "episodes", "steps", *BUDGETS, *_MEASURES, "seconds")
"""Columns of the iterations of all methods, in addition to :func:`loss_columns`; :mod:`plab.config.families`
has those of a family."""

EVALUATION = (*_MEASURES, "score_printed", "iou_initial", "iou_target_self")
"""Scalars of the final evaluation, in addition to :func:`loss_columns`."""

_NAME = re.compile(r"(?!/)(?!(?:.*/)?\.\.(?:/|$))[^\\\x00-\x1f\x7f]{1,200}")
"""Names that are safe in :func:`member_name`."""


class ResultsError(PlabError, RuntimeError):
    """A result file cannot be read or written; the message names the file and the reason."""


class NewerSchemaError(ResultsError):
    """A result file has a newer schema version; it is never moved or replaced."""


class RunBusyError(ResultsError):
    """A run is in progress in another process."""

    exit_code = 1


@dataclasses.dataclass
class RunResult:
    """Content of a result file.

    Attributes:
        config: Resolved configuration, plain nested dictionaries.
        config_hash: :func:`config_hash` of ``config``.
        status: One of :data:`STATUSES`.
        message: One-line reason why the run failed or stopped; empty otherwise.
        provenance: Versions, platform, commit, device, precision, seed, start time: flat scalars.
        wall_time: Seconds spent in each phase, summed over resumptions.
        columns: Columns of the iterations, or of the evaluations, shape [iteration] each; they are listed in
            docs/results.md.
        best_actions: Best actions found, in [-1, 1], shape [T, A]; None before the first iteration.
        best_iteration: Iteration of the best actions, -1 if there are none.
        best_loss: Their trajectory loss in the contact model of the rollouts.
        evaluation: Scalars of the final evaluation in the hard contact model; empty before it.
        labels: Meaning and unit of the loss's terms, by column.
        masses: Mass tensors by name (``initial``, ``final``, ``target``), each of shape [n, n, n].
        resume: Nested state for resuming the run: arrays, numbers, strings; None in finished files.
        path: File this was read from.
    """

    config: dict[str, Any]
    config_hash: str
    status: str = "running"
    message: str = ""
    provenance: dict[str, Any] = dataclasses.field(default_factory=dict)
    wall_time: dict[str, float] = dataclasses.field(default_factory=dict)
    columns: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    best_actions: np.ndarray | None = None
    best_iteration: int = -1
    best_loss: float = float("nan")
    evaluation: dict[str, float] = dataclasses.field(default_factory=dict)
    labels: dict[str, str] = dataclasses.field(default_factory=dict)
    masses: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    resume: dict[str, Any] | None = None
    path: Path | None = None

    @property
    def rows(self) -> int:
        """Number of iterations, or evaluations."""
        return len(next(iter(self.columns.values()), ()))

    @property
    def iterations(self) -> pd.DataFrame:
        """The columns as a table, a row per iteration or evaluation; changes do not affect the columns."""
        # Imported here, because recording a run does not need pandas.
        import pandas as pd

        return pd.DataFrame(self.columns)

    @property
    def score(self) -> float:
        """Score of a finished run under its protocol, in [0, 1].

        With ``protocol.score=best`` the score of the final evaluation; with ``last`` that of the last
        iteration, in the contact model of the iterations, as logged by the PlasticineLab release; for
        policies the mean over the last, exploratory training episodes. Methods that select by score, such as
        planners, and external methods always use the final evaluation.
        """
        if scores_last_iteration(self.config):
            return last_score(self.columns)
        return self.evaluation["score"]


def stored_config(text: str) -> dict[str, Any]:
    """Parse the configuration in a result file.

    Raises:
        ValueError: If its names would lead outside a folder.
    """
    config = json.loads(text)
    for key in ("task.name", "variant", "method.name"):
        if not _NAME.fullmatch(name := str(lookup(config, key))):
            raise ValueError(f"{key} in config is no name: {name!r:.80}")
    return config


def scores_last_iteration(config: Mapping[str, Any]) -> bool:
    """Return whether a run's score is that of its last iteration: see :attr:`RunResult.score`."""
    own = FAMILIES.get(config["method"]["family"])
    return config["protocol"]["score"] == "last" and own is not None and own.ranking == "loss"


def last_score(rows: Mapping[str, np.ndarray]) -> float:
    """Return the score of the last iteration as simulated, given the columns of the iterations."""
    trained = rows.get("train_score", [np.nan])[-1]
    # There may be no completed training episode.
    return float(rows["score"][-1] if np.isnan(trained) else trained)


def loss_columns(config: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the columns of the loss terms of a configuration with nonzero weight."""
    return tuple(f"loss_{name}" for name, weight in config["method"]["loss_weights"].items() if weight)


def row_count(method: Mapping[str, Any]) -> int | None:
    """Return the number of rows of a finished run, if the section ``method`` determines it."""
    if "stages" in method:
        return sum(stage["iterations"] for stage in method["stages"].values())
    return method.get("iterations")
