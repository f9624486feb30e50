"""Gymnasium wrappers that keep an agent's best plan within each budget in a file.

from plab.submissions import record

env = record(gymnasium.make("plab/Move-v1"), "recordings")
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeVar, overload

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper

from plab.config import Config
from plab.envs.core import EpisodeBatch
from plab.envs.single import PlabEnv
from plab.envs.vector import PlabVectorEnv
from plab.report.series import BUDGETS
from plab.results import ResultsError
from plab.submissions.submission import (
    SUFFIX,
    Digests,
    Entry,
    Submission,
    SubmissionError,
    configuration_of,
    encode,
    write,
)

__all__ = ["Recorder", "VectorRecorder", "record"]

_ledgers: dict[Path, _Ledger] = {}
"""Ledgers of this process by file: environments of one configuration share one, and their steps add up."""

Observation = TypeVar("Observation")
Action = TypeVar("Action")


class _Ledger:
    """Best episodes of one configuration, one within each budget, in a file.

    Attributes:
        steps: Environment steps simulated so far.
    """

    def __init__(self, cfg: Config, path: Path) -> None:
        """Begin with nothing, and take the file's name.

        Raises:
            SubmissionError: If there is a file already.
            ResultsError: If it cannot be written.
        """
        self.steps = 0
        self._configuration, self._digests = configuration_of(cfg), Digests.of(cfg)
        self._best: dict[float, Entry] = {}
        self._path = path
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # Without entries: two processes cannot both create it.
            with self._path.open("xb") as file:
                file.write(encode(Submission(None, ())))
        except FileExistsError:
            raise SubmissionError(
                f"{self._path} is there already: record into another folder, or remove it"
            ) from None
        except OSError as error:
            raise ResultsError(f"cannot write {self._path}: {error.strerror or error}") from error

    def episode(self, actions: np.ndarray, score: float) -> None:
        """Take a whole episode into account: its actions, shape [T, A], and the score that they reached."""
        better = [
            limit
            for limit in (*BUDGETS, math.inf)
            if self.steps <= limit and (limit not in self._best or score > self._best[limit].score)
        ]
        if not better:
            return
        entry = Entry(self._configuration, self._digests, self.steps, score, np.clip(actions, -1.0, 1.0))
        self._best |= dict.fromkeys(better, entry)
        kept = {best.steps: best for best in self._best.values()}
        write(Submission(None, tuple(kept[steps] for steps in sorted(kept))), self._path)


def _ledgers_of(batch: EpisodeBatch, folder: str | Path) -> list[_Ledger]:
    """Return the ledger of each sub-environment."""
    if batch.contact != "hard":
        raise SubmissionError("the contact model is soft: scores are of the hard one")
    found = []
    for cfg in batch.configs:
        path = Path(folder).resolve() / f"{configuration_of(cfg).name}{SUFFIX}"
        if path not in _ledgers or not path.exists():
            _ledgers[path] = _Ledger(cfg, path)
        found.append(_ledgers[path])
    return found


class Recorder(
    gymnasium.Wrapper[Observation, Action, Observation, Action], gymnasium.utils.RecordConstructorArgs
):
    """Records one environment; see :func:`record`."""

    def __init__(self, env: gymnasium.Env[Observation, Action], folder: str | Path) -> None:
        """Wrap an environment; arguments and errors are those of :func:`record`."""
        gymnasium.utils.RecordConstructorArgs.__init__(self, folder=str(folder))
        gymnasium.Wrapper.__init__(self, env)
        inner: Any = env
        while isinstance(inner, gymnasium.Wrapper):
            if isinstance(inner, gymnasium.ActionWrapper):
                raise SubmissionError(
                    f"{type(inner).__name__} changes actions: record the environment inside of it"
                )
            inner = inner.env
        if not isinstance(inner, PlabEnv):
            raise SubmissionError(f"{type(inner).__name__} is no environment of plab's")
        (self._ledger,) = _ledgers_of(inner.batch, folder)
        self._actions: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; one that has not ended is not recorded, its steps count."""
        self._actions = []
        return self.env.reset(**kwargs)

    def step(self, action: Action) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Advance by one step, and record the episode if that ends it."""
        taken = np.array(action, np.float64)
        result = self.env.step(action)
        self._actions.append(taken)
        self._ledger.steps += 1
        if result[3]:
            self._ledger.episode(np.stack(self._actions), float(result[4]["score"]))
        return result


class VectorRecorder(VectorWrapper):
    """Records many environments in one simulator; see :func:`record`."""

    def __init__(self, env: VectorEnv[Any, Any, Any], folder: str | Path) -> None:
        """Wrap environments; arguments and errors are those of :func:`record`."""
        super().__init__(env)
        if not isinstance(env, PlabVectorEnv):
            raise SubmissionError(
                f"{type(env).__name__}: record each environment inside of it, or what make_vec gives at once"
            )
        self._ledgers = _ledgers_of(env.batch, folder)
        self._actions: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start the episodes; those that have not ended are not recorded, their steps count."""
        self._actions = []
        return self.env.reset(**kwargs)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all by one step, and record the episodes if that ends them."""
        taken = np.array(actions, np.float64)
        result = self.env.step(actions)
        self._actions.append(taken)
        for ledger in self._ledgers:
            ledger.steps += 1
        if result[3].all():
            episodes = np.stack(self._actions, axis=1)
            self._actions = []
            scores = result[4]["final_info"]["score"]
            for ledger, own, score in zip(self._ledgers, episodes, scores, strict=True):
                ledger.episode(own, float(score))
        return result


@overload
def record(env: VectorEnv[Any, Any, Any], folder: str | Path) -> VectorRecorder: ...
@overload
def record(env: gymnasium.Env[Observation, Action], folder: str | Path) -> Recorder[Observation, Action]: ...
def record(env: Any, folder: str | Path) -> Any:
    """Record what an agent reaches, for ``python -m plab.submit``.

    Of each configuration a file in ``folder`` holds the actions of the best episode within each budget of
    :data:`plab.report.series.BUDGETS` and of the best one of all, with the environment steps simulated until
    then. All environments of one configuration in a process share it. It is written whenever an episode is
    better.

    Args:
        env: An environment of plab's, ``gymnasium.make`` or ``gymnasium.make_vec``, in the hard contact
            model; wrappers that change actions belong around the recorder.
        folder: Folder of the recordings, of this training only.

    Returns:
        The environment, to be used in place of ``env``.

    Raises:
        SubmissionError: If that cannot be recorded, or the folder has a recording of another process.
        plab.results.ResultsError: If the file cannot be written.
    """
    return (VectorRecorder if isinstance(env, VectorEnv) else Recorder)(env, folder)
