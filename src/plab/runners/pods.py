"""Policy optimization via differentiable simulation (``pods``): imitation of the policy's own episodes,
improved by the simulator's gradient.

After Mora et al., PODS: Policy Optimization via Differentiable Simulation (ICML 2021), with updates by Adam
instead of gradient descent or second-order steps. In each round the policy acts in each scene. Its actions
are improved by some updates along the gradient of the trajectory loss and simulated again. The policy learns
the improved actions in the resulting states, and in the states of its own episodes. The gradient improves
action sequences, which is much easier than improving a network. The sequences of different scenes remain
similar, because all of them start from the policy. If there are more scenes than environments, rounds
alternate between them, and the policy imitates the latest actions of each scene. To reproduce a result:

    python -m plab.run task=Move variant=random seed_scene=9000 observe_target=1 observe_particles=10 \
        method=pods method.scenes=1280 method.shift=0.2 method.episodes=15360 seed=0 sim.device=cuda
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from plab.config import Config, ranges
from plab.config.families import GRADIENT, Appearance, Family, Rule
from plab.plugins import torch
from plab.runners.bc import ImitationRunner
from plab.runners.policy import set_rate
from plab.runners.training import ActorConfig

if TYPE_CHECKING:
    from plab.envs.core import EpisodeBatch


@dataclass
class PodsConfig(ActorConfig):
    """Policy optimization via differentiable simulation.

    Attributes:
        updates: Gradient updates of the actions per round.
        action_lr: Learning rate of the actions, in units of an action.
        epochs: Training passes after a round, each over as many actions as a round has.
        batch_size: Actions per update of the policy.
        observation_noise: Standard deviation of the noise on observations, relative to their standard
            deviation.
        shift: Largest common shift of observed positions along x and z [domain units].
    """

    updates: int = field(metadata=ranges.COUNT)
    action_lr: float = field(metadata=ranges.POSITIVE)
    epochs: int = field(metadata=ranges.COUNT)
    batch_size: int = field(metadata=ranges.COUNT)
    observation_noise: float = field(metadata=ranges.FINITE)
    shift: float = field(metadata=ranges.FINITE)


class PodsRunner(ImitationRunner):
    """Runner of a policy and its rounds of training episodes."""

    def prepare(self, batch: EpisodeBatch) -> None:
        # Episodes of the policy, with gradient, and with the improved actions.
        self.round_episodes = self.method.updates + 2, self.method.updates
        super().prepare(batch)
        self._rounds: list[tuple[torch.Tensor, torch.Tensor]] = []

    def environments(self, cfg: Config) -> list[Config]:
        """Return the configurations of one scene per environment, up to ``num_envs``."""
        return super().environments(cfg)[: max(1, self.method.scenes)]

    def learn(self, rate_left: float) -> None:
        """Run a round: act, improve the actions, and imitate them."""
        method, batch, self._failed = self.method, self.batch, set[int]()
        self._numbers = self.begin_round()
        self.freeze_moments()
        before, actions = self._episode(None, "train")
        improved = self._improved(actions, method.action_lr * rate_left)
        after, _ = self._episode(improved, "plan")
        if whole := [e for e in range(batch.size) if e not in self._failed]:
            # Also imitate in the states of the policy's own episodes, so that deviations are corrected.
            seen = torch.cat([before[whole], after[whole]]).flatten(0, 1)
            wanted = torch.cat([improved[whole]] * 2).flatten(0, 1)
            self.statistics.update(seen.double().cpu().numpy())
            self.freeze_moments()
            set_rate(self._optimizer, method.lr * rate_left)
            # The latest round of each scene.
            self._rounds = [*self._rounds, (seen, wanted)][-max(1, math.ceil(method.scenes / batch.size)) :]
            every, given = map(torch.cat, zip(*self._rounds, strict=True))
            count = math.ceil(method.epochs * len(seen) / method.batch_size)
            self.imitate(self.scaled(every), given, count)

    def _episode(self, actions: torch.Tensor | None, name: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Run an episode with given actions, shape [env, T, A], or the policy, and record reward and score
        under a name; return observations before each step, shape [env, T, entry], and actions."""
        from plab.envs.tensors import TensorEnv

        env, observed, taken, total = TensorEnv(self.batch), [], [], 0.0
        seen = env.reset(episode=self._numbers)
        for t in range(self._horizon):
            with torch.no_grad():
                chosen = self.network(self.scaled(seen)) if actions is None else actions[:, t]
            step = env.step(chosen.double(), strict=False)
            observed.append(seen)
            taken.append(chosen)
            seen, total = step.observation, total + step.reward
        self._note_failures(step.failures)
        self.note(**{f"{name}_reward": total, f"{name}_score": step.info["score"]})
        return torch.stack(observed, 1), torch.stack(taken, 1)

    def _improved(self, actions: torch.Tensor, rate: float) -> torch.Tensor:
        """Return actions, shape [env, T, A], improved by Adam along the gradient of the trajectory loss."""
        from plab.envs.tensors import simulator_input

        plan = torch.nn.Parameter(actions.clone())
        optimizer = torch.optim.Adam([plan], lr=rate)
        for _ in range(self.method.updates):
            given = simulator_input(plan, self.batch.problem.simulator)
            tried = self.batch.problem.rollout(given, gradient=True, strict=False, exact=False)
            self._note_failures(tried.failures)
            plan.grad = torch.as_tensor(tried.gradient, dtype=plan.dtype, device=plan.device)
            # Diverged episodes have no gradient.
            plan.grad[list(self._failed)] = 0.0
            optimizer.step()
            with torch.no_grad():
                plan.clamp_(-1.0, 1.0)
        return plan.detach()

    def _note_failures(self, failures: Mapping[int, str]) -> None:
        self._failed |= set(failures)
        self.broken[0] += failures.values()

    def state(self) -> dict[str, Any]:
        return super().state() | {"rounds": self._rounds}

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        self._rounds = [(seen.to(self._device), wanted.to(self._device)) for seen, wanted in state["rounds"]]


_COLUMNS = ("train_reward", "train_score", "plan_reward", "plan_score")

FAMILY = Family(
    config=PodsConfig,
    runner=PodsRunner,
    columns=_COLUMNS,
    may_be_nan=_COLUMNS,
    rules={"pods": Rule(PodsRunner, PodsConfig)},
    kind=GRADIENT,
    methods={"pods": Appearance("PODS", "#999933", "--")},
)
