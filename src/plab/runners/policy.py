"""Trained policies: kept in a file beside the result, and taken from there.

The file is an ``.npz`` of arrays alone: the networks' parameters by their names, the bounds of observations
and actions, and a header in JSON with the section ``method`` of the run, from which the networks are made
anew. Reading it unpickles and imports nothing.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium.spaces import Box
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from plab.config import ConfigError, PolicyConfig
from plab.families import FAMILIES, family
from plab.files import DAMAGE, one_line, read_arrays
from plab.results import ResultsError
from plab.results.files import replace_file
from plab.runners.model_state import module_arrays, restore_module
from plab.runners.rl_models import CLIP, Spaces, model_kind

__all__ = ["Policy", "load_policy", "policy_path", "save_policy"]

EPSILON = 1e-8
"""Added to variances of observations, as Stable-Baselines3 does."""

_FORMAT = "plab-policy 1"

_PARAMETER = "policy/"
"""What the names of the networks' parameters begin with."""


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


def save_policy(
    result: Path, method: PolicyConfig, policy: BasePolicy, moments: tuple[np.ndarray, np.ndarray] | None
) -> None:
    """Write a policy beside the result.

    Args:
        result: The run's result file.
        method: The section ``method`` of its configuration.
        policy: Stable-Baselines3's policy.
        moments: Means and variances of the observations that scale them, shape [entry]; None if they were not
            scaled.

    Raises:
        ResultsError: If the file cannot be written.
    """
    header = json.dumps({"format": _FORMAT, "method": asdict(method)})
    arrays: dict[str, Any] = {"header": np.array(header)}
    for name in ("observation", "action"):
        space = cast(Box, getattr(policy, f"{name}_space"))
        arrays |= {f"{name}_low": space.low, f"{name}_high": space.high}
    if moments is not None:
        arrays |= {"mean": np.asarray(moments[0]), "variance": np.asarray(moments[1])}
    arrays |= {f"{_PARAMETER}{name}": values for name, values in module_arrays(policy).items()}
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
            outside plab whose module has not been imported.
    """
    path = policy_path(Path(result))
    try:
        policy = _policy(path)
    except FileNotFoundError:
        raise ResultsError(
            f"{path} is not there: sac, td3, ppo, shac and pods write it when a run ends; see docs/rl.md"
        ) from None
    except ResultsError:
        raise
    except DAMAGE as error:
        raise ResultsError(
            f"{path} is no policy of plab's ({one_line(error)}): run it again with force=true"
        ) from error
    # What the device answers says nothing about the file.
    policy.network = policy.network.to(get_device(device))
    return policy


def _policy(path: Path) -> Policy:
    arrays = read_arrays(path)
    if "header" not in arrays and "policy" in arrays:
        raise ValueError("it is pickled, as by earlier versions of plab, and not read any more")
    header = json.loads(str(arrays["header"][()]))
    if header["format"] != _FORMAT:
        raise ValueError(f"it is of the format {header['format']!r:.80}, not {_FORMAT!r}")
    method = _method(header["method"], path)
    spaces = Spaces(*(_space(arrays, name) for name in ("observation", "action")))
    own = [name for name in arrays if name.startswith(_PARAMETER)]
    parameters = {name.removeprefix(_PARAMETER): arrays[name] for name in own}
    _require_room(method, spaces, parameters)
    network = model_kind(method.family, method.algorithm).policy(method, spaces)
    restore_module(network, parameters)
    moments = [arrays.get(name) for name in ("mean", "variance")]
    for values in moments:
        if values is not None and values.shape != spaces.observation_space.shape:
            raise ValueError(f"its statistics have shape {list(values.shape)}")
    return Policy(network, *moments)


def _method(section: Any, path: Path) -> PolicyConfig:
    """Return the section ``method`` that a policy's header holds, of the type of its family."""
    name = section["family"]
    if not isinstance(name, str):
        raise ValueError("its method has no family")
    # A file does not choose what is imported.
    if name not in FAMILIES and (module := name.partition(":")[0]) not in sys.modules:
        raise ResultsError(f"{path}: its method is {name!r:.80}, outside plab: import {module!r:.80} before")
    if "${" in json.dumps(section):
        raise ValueError("its method refers to something else")
    try:
        kind = family(name).config_type(section["algorithm"])
        # Of files older than `logger`, and of those of shac that had profiles without any in them.
        gone = {"tensorboard", "profile", "profiles"} - {one.name for one in fields(kind)}
        known = {key: value for key, value in section.items() if key not in gone}
        method = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), known))
        cast(PolicyConfig, method).check("method")
    except ConfigError as error:
        raise ResultsError(f"{path}: {one_line(error)}") from error
    except OmegaConfBaseException as error:
        raise ValueError(f"its method is none: {(error.msg or str(error)).splitlines()[0]}") from error
    if not isinstance(method, PolicyConfig):
        raise ValueError(f"policies are no part of {name}")
    return method


def _space(arrays: Mapping[str, np.ndarray], name: str) -> Box:
    low, high = arrays[f"{name}_low"], arrays[f"{name}_high"]
    if low.ndim != 1 or low.shape != high.shape or not (low <= high).all():
        raise ValueError(f"the bounds of its {name}s are none")
    return Box(low, high, dtype=np.float32)


def _require_room(method: PolicyConfig, spaces: Spaces, parameters: Mapping[str, np.ndarray]) -> None:
    """See that networks of this size can be what the file holds, before they are made."""
    sizes = [space.shape[0] for space in spaces]
    widths = [sizes[0], *getattr(method, "hidden", ()), sizes[1]]
    needed = sum(math.prod(pair) for pair in itertools.pairwise(widths))
    there = sum(values.size for values in parameters.values())
    if needed > there:
        raise ValueError(f"it has {there} parameters, its networks at least {needed}")
