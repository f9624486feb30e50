"""Trained policies: keys, torch settings and policy files.

The file beside a result, ``<name>.policy.npz``, contains only arrays: the parameters of the networks by name,
the bounds of observations and actions, and a JSON header with the ``method`` section of the run, from which
the networks are rebuilt. Reading it unpickles and imports nothing.
"""

from __future__ import annotations

import io
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from gymnasium.spaces import Box
from omegaconf import OmegaConf

from plab.config import MethodConfig, ranges
from plab.config.families import family, known_family
from plab.config.run import SUFFIX
from plab.errors import ArgumentError
from plab.files import read_arrays
from plab.plugins import torch
from plab.results import ResultsError
from plab.results.run_file import explained, replace_file
from plab.scenes import DEVICES

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy

    from plab.envs.core import EpisodeBatch

CLIP = 10.0
"""Largest observation and reward, in units of their running standard deviations."""

EPSILON = 1e-8
"""Added to variances of observations, as in Stable-Baselines3."""

_FORMAT = "plab-policy 1"

_PARAMETER = "policy/"
"""Prefix of the names of the networks' parameters."""


@dataclass
class PolicyConfig(MethodConfig):
    """Keys of methods that save their policy.

    Attributes:
        algorithm: Learning algorithm of the family.
        episodes: Number of training episodes.
        evaluate_every: Episodes between two evaluations of the deterministic policy.
        torch_device: Device of the networks, ``cpu`` or ``cuda``.
        torch_threads: CPU threads of torch.
        lr: Learning rate.
        hidden: Widths of the hidden layers.
    """

    algorithm: str
    episodes: int = field(metadata=ranges.COUNT)
    evaluate_every: int = field(metadata=ranges.COUNT)
    torch_device: str = field(metadata=ranges.within(ranges.one_of, DEVICES))
    torch_threads: int = field(metadata=ranges.THREADS)
    lr: float = field(metadata=ranges.POSITIVE)
    hidden: list[int] = field(metadata=ranges.WIDTHS)


class Spaces(NamedTuple):
    """Observation and action spaces."""

    observation_space: Box
    action_space: Box

    @classmethod
    def of(cls, batch: EpisodeBatch) -> Spaces:
        """Return the spaces of a batch with vector observations."""
        return cls(cast(Box, batch.observation_space), batch.action_space)

    @property
    def sizes(self) -> tuple[int, int]:
        """Entries of an observation and components of an action."""
        return self.observation_space.shape[0], self.action_space.shape[0]


@contextmanager
def torch_settings(threads: int, *, tf32: bool = False) -> Iterator[None]:
    """Set torch's CPU threads, enable TF32 products on CUDA if ``tf32``, and disable checks of distribution
    arguments, inside the ``with`` block. The checks take a tenth of an update, and states and losses are
    checked for NaN elsewhere."""
    before, checks = torch.get_num_threads(), torch.distributions.Distribution._validate_args
    precision = torch.get_float32_matmul_precision()
    torch.set_num_threads(threads)
    if tf32:
        torch.set_float32_matmul_precision("high")
    torch.distributions.Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        torch.set_float32_matmul_precision(precision)
        torch.distributions.Distribution.set_default_validate_args(checks)


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters, in place if it is a tensor."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def packed(state: Mapping[str, Any]) -> np.ndarray:
    """Serialise tensors and numbers in nested dictionaries and lists with torch.save."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return np.frombuffer(buffer.getvalue(), np.uint8)


def unpacked(array: np.ndarray) -> dict[str, Any]:
    """Restore the argument of :func:`packed` on the CPU, without executing anything."""
    return torch.load(io.BytesIO(array.tobytes()), "cpu", weights_only=True)


def first_policy(method: PolicyConfig, spaces: Spaces, seed: int = 0) -> BasePolicy:
    """Return the initial policy, created by ``make_policy(method, spaces)`` of the algorithm's rule, on the
    CPU; the state of random generators is preserved."""
    rule = family(method.family).rules[method.algorithm].what
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return rule.make_policy(method, spaces)


@dataclass
class Policy:
    """A trained, deterministic policy.

    Attributes:
        network: Stable-Baselines3's policy.
        mean: Means of the observations, shape [entry], by which they are scaled; None without scaling.
        variance: Variances of the observations, likewise.
    """

    network: BasePolicy
    mean: np.ndarray | None = None
    variance: np.ndarray | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return actions, shape [env, action], for observations from environments, shape [env, entry]."""
        entries, wanted = np.shape(observation)[-1], cast(Box, self.network.observation_space).shape[0]
        if entries != wanted:
            raise ArgumentError(
                f"observations have {entries} entries, those of the policy's training {wanted}: "
                "use its task, observe_particles and observe_target"
            )
        if self.mean is not None and self.variance is not None:
            scaled = (np.asarray(observation) - self.mean) / np.sqrt(self.variance + EPSILON)
            observation = np.clip(scaled, -CLIP, CLIP).astype(np.float32)
        return self.network.predict(observation, deterministic=True)[0]


def policy_path(result: Path) -> Path:
    """Return the path of the policy file for a result file."""
    return result.with_suffix(".policy.npz")


def save_policy(result: Path, method: PolicyConfig, policy: Policy) -> None:
    """Write the policy file of a result, with the ``method`` section of its configuration; raise ResultsError
    on failure."""
    arrays: dict[str, Any] = {"header": np.array(json.dumps({"format": _FORMAT, "method": asdict(method)}))}
    for name in ("observation", "action"):
        space = cast(Box, getattr(policy.network, f"{name}_space"))
        arrays |= {f"{name}_low": space.low, f"{name}_high": space.high}
    if policy.mean is not None:
        arrays |= {"mean": policy.mean, "variance": policy.variance}
    parameters = policy.network.state_dict()
    arrays |= {f"{_PARAMETER}{name}": values.cpu().numpy() for name, values in parameters.items()}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    replace_file(policy_path(result), buffer.getvalue(), sync=True)


def load_policy(result: str | Path, device: str = "cpu") -> Policy:
    """Load the trained policy of a run.

    Args:
        result: The run's result file, as in the column ``path`` of a table of results.
        device: Device of the network, ``cpu`` or ``cuda``.

    Raises:
        ResultsError: If the policy is missing, its file is damaged, or the external module of its family has
            not been imported; or ``result`` is another file.
    """
    if Path(result).suffix != SUFFIX:
        raise ResultsError(f"{result} is not a result file: name the run's {SUFFIX} file")
    path = policy_path(Path(result))
    if not path.exists():
        why = "sac, td3, ppo, shac, pods and bc write it when a run ends, and archives do not contain it"
        raise ResultsError(f"{path} does not exist: {why}")
    with explained(path):
        policy = _policy(path)
    # Errors of the device do not concern the file.
    policy.network = policy.network.to(device)
    return policy


def _policy(path: Path) -> Policy:
    arrays = read_arrays(path)
    # NumPy's text may contain invalid characters.
    header = json.loads(str(arrays["header"][()]).encode())
    if header["format"] != _FORMAT:
        raise ValueError(f"it has the format {header['format']!r:.80}, not {_FORMAT!r}")
    section = header["method"]
    name = str(section["family"])
    # A file must not determine imports.
    if (own := known_family(name)) is None:
        module = name.partition(":")[0]
        raise ResultsError(f"{path}: its method is {name!r:.80}, outside plab: import {module!r:.80} first")
    merged = OmegaConf.merge(OmegaConf.structured(own.config_type(section["algorithm"])), section)
    method = cast(PolicyConfig, OmegaConf.to_object(merged))
    method.check("method")
    spaces = Spaces(*(Box(arrays[f"{n}_low"], arrays[f"{n}_high"]) for n in ("observation", "action")))
    kept = [name for name in arrays if name.startswith(_PARAMETER)]
    parameters = {name.removeprefix(_PARAMETER): torch.tensor(arrays[name]) for name in kept}
    # Checked before networks of that size are created.
    widths = [spaces.sizes[0], *method.hidden, spaces.sizes[1]]
    needed = sum(map(math.prod, itertools.pairwise(widths)))
    if needed > (there := sum(values.numel() for values in parameters.values())):
        raise ValueError(f"it has {there} parameters, but its networks have at least {needed}")
    network = first_policy(method, spaces)
    network.load_state_dict(parameters)
    return Policy(network, arrays.get("mean"), arrays.get("variance"))
