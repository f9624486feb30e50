"""Learning algorithm of another library, outside plab: truncated quantile critics from SB3-Contrib.

plab run --config-dir examples/own_rl/conf method=tqc task=Move
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from sb3_contrib import TQC
from stable_baselines3.common.vec_env import VecEnv

from plab.config import ConfigError
from plab.runners import FAMILIES, Rule
from plab.runners.agents import OffPolicyConfig
from plab.runners.sb3 import ModelKind, off_policy

__all__ = ["FAMILY", "TqcConfig"]


@dataclass
class TqcConfig(OffPolicyConfig):
    """Keys of truncated quantile critics, in addition to those of all methods with a replay buffer.

    Attributes:
        critics: Number of critics.
        quantiles: Number of quantiles of the return predicted by each critic.
        dropped_quantiles: Number of largest quantiles per critic that the target omits.
    """

    critics: int
    quantiles: int
    dropped_quantiles: int

    def check(self, path: str) -> None:
        """Raise ConfigError for a value out of range."""
        super().check(path)
        if self.critics < 1:
            raise ConfigError(f"{path}.critics must be at least 1, not {self.critics}")
        if not 0 <= self.dropped_quantiles < self.quantiles:
            raise ConfigError(
                f"{path}.dropped_quantiles must be in [0, quantiles), not {self.dropped_quantiles}"
            )


def arguments(method: TqcConfig, env: VecEnv) -> dict[str, Any]:
    """Return the arguments of the library's class."""
    shared = off_policy(method)
    networks = {"n_critics": method.critics, "n_quantiles": method.quantiles}
    return shared | {
        "policy_kwargs": shared["policy_kwargs"] | networks,
        "top_quantiles_to_drop_per_net": method.dropped_quantiles,
    }


FAMILY = replace(
    FAMILIES["sb3"],
    config=TqcConfig,
    rules={"tqc": Rule(ModelKind(TQC, arguments))},
)
