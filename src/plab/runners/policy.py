"""Trained policies: kept in a file beside the result, and taken from there."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from plab.config_errors import ConfigError
from plab.results import ResultsError
from plab.results.files import replace_file
from plab.runners.rl_models import CLIP, model_kind

__all__ = ["Policy", "load_policy", "model_policy", "policy_path", "save_policy"]

EPSILON = 1e-8
"""Added to variances of observations, as Stable-Baselines3 does."""

_BROKEN = (OSError, ValueError, KeyError, EOFError, RuntimeError, pickle.UnpicklingError, zipfile.BadZipFile)
"""What NumPy and PyTorch raise at a file that is cut off or of another kind."""


class Policy:
    """A trained policy, deterministic.

    Attributes:
        network: Stable-Baselines3's policy, which wants observations as it has seen them in training.
    """

    def __init__(self, network: BasePolicy, mean: np.ndarray | None, variance: np.ndarray | None) -> None:
        """Take over a network.

        Args:
            network: The policy of a model.
            mean: Means of the observations that scale them, shape [entry]; None if they were not scaled.
            variance: Their variances, shape [entry].
        """
        self.network = network
        self._mean, self._variance = mean, variance

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return actions, shape [env, action], for observations as the environments give them, shape [env,
        entry]."""
        if self._mean is not None and self._variance is not None:
            scaled = (observation - self._mean) / np.sqrt(self._variance + EPSILON)
            observation = np.clip(scaled, -CLIP, CLIP).astype(np.float32)
        return self.network.predict(observation, deterministic=True)[0]


def policy_path(result: Path) -> Path:
    """Return the file of the policy of a run with this result file."""
    return result.with_suffix(".policy.npz")


def model_policy(family: str, algorithm: str, state: Mapping[str, Any]) -> BasePolicy:
    """Return the policy of a checkpoint.

    Args:
        family: Family of the method, as ``method.family`` names it.
        algorithm: Learning algorithm, as ``method.algorithm`` names it.
        state: The checkpoint, a :meth:`plab.runners.rl_trainer.Trainer.state`.
    """
    # The replay buffer of a training that is over is not to be looked for.
    without_buffer: dict[str, Any] = {
        "replay_buffer_class": None,
        "replay_buffer_kwargs": {},
        "buffer_size": 1,
    }
    kind: type[BaseAlgorithm] = model_kind(family, algorithm).model
    model = kind.load(io.BytesIO(state["model"].tobytes()), device="cpu", custom_objects=without_buffer)
    return model.policy


def save_policy(
    result: Path,
    family: str,
    algorithm: str,
    policy: BasePolicy,
    moments: tuple[np.ndarray, np.ndarray] | None,
) -> None:
    """Write a policy beside the result.

    Args:
        result: The run's result file.
        family: Family of the method, as ``method.family`` names it.
        algorithm: Learning algorithm, as ``method.algorithm`` names it.
        policy: Stable-Baselines3's policy.
        moments: Means and variances of the observations that scale them, shape [entry]; None if they were not
            scaled.

    Raises:
        ResultsError: If the file cannot be written.
    """
    buffer = io.BytesIO()
    # torch takes files as it takes paths.
    policy.save(cast(str, buffer))
    arrays: dict[str, Any] = {
        "family": np.array(family),
        "algorithm": np.array(algorithm),
        "policy": np.frombuffer(buffer.getvalue(), np.uint8),
    }
    if moments is not None:
        arrays |= {"mean": np.asarray(moments[0]), "variance": np.asarray(moments[1])}
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    replace_file(policy_path(result), packed.getvalue(), sync=True)


def load_policy(result: str | Path, device: str = "cpu") -> Policy:
    """Return the policy that a run has trained.

    Args:
        result: The run's result file, as in the column ``path`` of a table of results.
        device: Where the network is to be, ``cpu`` or ``cuda``.

    Raises:
        ResultsError: If there is no policy beside the result, its file is broken, or it is of a family
            outside plab whose module is not found.
    """
    path = policy_path(Path(result))
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        # Files of earlier versions are all of plab's own family.
        family = str(arrays.get("family", "rl"))
        kind = model_kind(family, str(arrays["algorithm"])).model.policy_aliases["MlpPolicy"]
        network = kind.load(cast(str, io.BytesIO(arrays["policy"].tobytes())), device="cpu")
    except FileNotFoundError:
        raise ResultsError(
            f"{path} is not there: sac, td3 and ppo write it when a run ends; see docs/rl.md"
        ) from None
    except ConfigError as error:
        raise ResultsError(f"{path}: {error}") from error
    except _BROKEN as error:
        raise ResultsError(
            f"{path} is no policy of plab's ({error}): run it again with force=true"
        ) from error
    # What the device answers says nothing about the file.
    return Policy(network.to(get_device(device)), arrays.get("mean"), arrays.get("variance"))
