"""A policy network trained through the simulator's gradient: ``apg``, analytic policy gradient.

Each iteration runs an episode of the policy, then the same actions once more with gradient. Observations are
treated as constants: how the actions change them, and thereby later actions, is left out of the gradient. To
reproduce a result:

    python -m plab.run task=Move variant=1 method=apg seed=0
"""

from __future__ import annotations

import io
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from plab.config_types import ApgConfig
from plab.progress import show_progress
from plab.results import RunFile
from plab.runners.common import kept_batches, measures, policy_episode, simulation_errors, torch_settings
from plab.runners.jobs import Job, title
from plab.torch import rollout

if TYPE_CHECKING:
    from plab.config import Config
    from plab.envs.core import EpisodeBatch

__all__ = ["PolicyTraining", "run_apg"]


def run_apg(jobs: Sequence[Job], note: str = "") -> None:
    """Train a policy network, evaluate the best actions in the hard contact model, finish the file.

    Args:
        jobs: One job; ``cfg.method`` is a :class:`plab.config.ApgConfig`. What an earlier process left in its
            file is taken up.
        note: Shown before the progress.

    Raises:
        plab.runners.RunError: If the loss, the gradient or the state stops being finite.
    """
    (job,) = jobs
    cfg, run, method = job.cfg, job.run, job.cfg.method_as(ApgConfig)
    with torch_settings(method.torch_threads), simulation_errors():
        with run.phase("build"):
            (episode,) = kept_batches(cfg, (1, method.contact))
            sizes = episode.observation_space.shape[0], episode.action_space.shape[0]
            training = PolicyTraining(method, *sizes, cfg.seed)
            if run.result.resume is not None:
                training.restore(run.result.resume)
        _optimise(cfg, episode, training, run, note)
        problem = episode.problem
        with run.phase("evaluate"):
            problem.simulator.set_contact("hard")
            best = cast(np.ndarray, run.result.best_actions)
            judged = problem.rollout(best[None], gradient=False)
    masses = {"initial": problem.initial_mass[0], "target": problem.target_mass[0]}
    run.finish(measures(judged), masses | {"final": cast(np.ndarray, judged.final_mass)[0]})


class PolicyTraining:
    """A policy network and the optimiser that improves it.

    Attributes:
        policy: Maps observations, shape [..., entry], to actions in (-1, 1), shape [..., A].
    """

    def __init__(self, method: ApgConfig, observation_size: int, action_dim: int, seed: int) -> None:
        """Make the network, with torch's own initial weights.

        Args:
            method: Widths of the layers and learning rate.
            observation_size: Entries of an observation.
            action_dim: Length A of the action vector.
            seed: Seed of the initial weights.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.policy = _network([observation_size, *method.hidden, action_dim])
        self._optimizer = torch.optim.Adam(self.policy.parameters(), lr=method.lr)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions for observations of shape [env, entry], shape [env, A]."""
        with torch.no_grad():
            return self.policy(torch.from_numpy(observations)).numpy()

    def step(self, loss: torch.Tensor) -> float:
        """Improve the policy by the gradient of a loss; return the gradient's norm over all weights."""
        self._optimizer.zero_grad()
        loss.backward()
        gradients = [parameter.grad for parameter in self.policy.parameters()]
        norm = torch.cat([part.flatten() for part in gradients if part is not None]).norm()
        self._optimizer.step()
        return float(norm)

    def state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, as an array of bytes."""
        file = io.BytesIO()
        torch.save({"policy": self.policy.state_dict(), "optimizer": self._optimizer.state_dict()}, file)
        return {"training": np.frombuffer(file.getvalue(), np.uint8)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`."""
        content = torch.load(io.BytesIO(state["training"].tobytes()), weights_only=True)
        self.policy.load_state_dict(content["policy"])
        self._optimizer.load_state_dict(content["optimizer"])


def _network(widths: Sequence[int]) -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(inputs, outputs), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1], torch.nn.Tanh())


def _optimise(cfg: Config, episode: EpisodeBatch, training: PolicyTraining, run: RunFile, note: str) -> None:
    """Do the iterations that the file does not hold yet."""
    start, total = len(run.result.iterations), cfg.method_as(ApgConfig).iterations
    with show_progress(note + title(cfg), start, total, enabled=cfg.progress) as report:
        for iteration in range(start, total):
            # The first rollout of a process compiles the kernels.
            with run.phase("compile" if iteration == start else "optimise"):
                row, actions = _iterate(episode, training, iteration)
            # Written so that the first loss beats the NaN that stands for none.
            better = not row["loss"] >= run.result.best_loss
            best: dict[str, Any] = {
                "best_actions": actions,
                "best_iteration": iteration,
                "best_loss": row["loss"],
            }
            run.record(row, training.state(), **(best if better else {}))
            best_text = f"best {run.result.best_loss:.5g}"
            report(iteration + 1, f"loss {row['loss']:.5g} score {row['score']:.3f} {best_text}")


def _iterate(
    episode: EpisodeBatch, training: PolicyTraining, iteration: int
) -> tuple[dict[str, float], np.ndarray]:
    """Do one iteration; return its row and the actions that it ran, shape [T, A]."""
    start = time.perf_counter()
    done = policy_episode(episode, training.act)
    # The actions again, now as functions of the weights; the same numbers but for rounding.
    actions = training.policy(torch.from_numpy(done.observations))
    norm = training.step(rollout(episode.problem, actions[None]).sum())
    row: dict[str, float] = {"iteration": iteration, "episodes": iteration}
    row["steps"] = iteration * episode.horizon
    row |= done.measures | {"gradient_norm": norm, "seconds": time.perf_counter() - start}
    return row, done.actions
