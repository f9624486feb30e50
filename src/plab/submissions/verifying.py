"""Verification of submissions by simulating all claims again, in float32 and in float64.

Policies are TorchScript or ONNX. Loading a policy executes it, so this happens only on request.
"""

from __future__ import annotations

import io
import json
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TypeAlias

import numpy as np

import plab
from plab.config import Config
from plab.envs.core import EpisodeBatch
from plab.results.run_file import explained, replace_file
from plab.results.running import now
from plab.scenes import PRECISIONS
from plab.submissions.submission import (
    SUFFIX,
    Configuration,
    Entry,
    Submission,
    SubmissionError,
    checksum,
)
from plab.targets.store import PHYSICS_VERSION

TOLERANCE = 0.02
"""Tolerance between claimed and simulated scores. The CPU is bitwise reproducible; on CUDA the last digits
vary, amplified by contact."""

HOLDS, LIES, BROKE_OFF, NOT_RUN = "holds", "does not hold", "broke off", "not run"

_BATCH = 25
"""Maximum number of configurations in one simulator."""

Policy: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Function of observations, float32, shape [batch, entry], that returns actions, shape [batch, action]."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of a claim.

    Attributes:
        entry: The claim.
        scores: Simulated score by precision; empty if it was not run.
        outcome: ``holds``, ``does not hold``, ``broke off`` or ``not run``.
        why: One-line reason, empty if it holds.
    """

    entry: Entry
    scores: Mapping[str, float]
    outcome: str
    why: str = ""


@dataclass(frozen=True)
class Verification:
    """Outcome of all claims of a file.

    Attributes:
        digest: SHA-256 of the submission, in hex.
        verdicts: A verdict for each entry, in the order of the file.
        overrides: Overrides of the simulation.
    """

    digest: str
    verdicts: tuple[Verdict, ...]
    overrides: tuple[str, ...]

    @property
    def outcomes(self) -> set[str]:
        """Set of the outcomes of all entries."""
        return {verdict.outcome for verdict in self.verdicts}


def verify(
    submission: Submission,
    overrides: Sequence[str] = (),
    *,
    run_policies: bool = False,
    precisions: Sequence[str] = PRECISIONS,
) -> Verification:
    """Simulate all entries of a submission again, with overrides such as ``sim.device=cuda``, in the given
    precisions.

    Its policies are programs from others, executed only with ``run_policies``.

    Raises:
        SubmissionError: If its physics, scenes or targets differ, or its plans or policies do not fit their
            tasks.
        plab.config.ConfigError: If an override is invalid.
    """
    given = tuple(overrides)
    cfgs = _configs(submission, given)
    played: dict[int, dict[str, tuple[float, str]]] = defaultdict(dict)
    # Each group fits into one simulator.
    alike: dict[tuple[str, str], list[int]] = defaultdict(list)
    for number, entry in enumerate(submission.entries):
        if run_policies or not entry.policy:
            alike[entry.configuration.task, entry.policy].append(number)
    policies = {name: load_policy(name, submission.policies[name]) for _, name in alike if name}
    # Changing the precision restarts Taichi.
    for precision in precisions:
        for (_, name), numbers in alike.items():
            entries = [submission.entries[number] for number in numbers]
            chosen = [cfgs[entry.configuration] for entry in entries]
            plans = [entry.actions for entry in entries if entry.actions is not None]
            actor = policies[name] if name else plans
            for number, one in zip(numbers, play(chosen, actor, precision, name), strict=True):
                played[number][precision] = one
    verdicts = tuple(_verdict(entry, played[n]) for n, entry in enumerate(submission.entries))
    return Verification(submission.digest, verdicts, given)


def _configs(submission: Submission, overrides: tuple[str, ...]) -> dict[Configuration, Config]:
    """Compose all configurations, and reject those that differ from the submission's."""
    versions = f"({submission.plab}, this is {plab.__version__})"
    if submission.physics != PHYSICS_VERSION:
        raise SubmissionError(
            f"{submission.path} is of physics version {submission.physics}, this plab simulates version "
            f"{PHYSICS_VERSION}: use its plab {versions}"
        )
    found: dict[Configuration, Config] = {}
    for entry in submission.entries:
        one = entry.configuration
        cfg = found[one] = found.get(one) or one.config(overrides)
        if entry.checksum != checksum(cfg):
            raise SubmissionError(
                f"{submission.path}: the scene or target of {one.name} is another one than here: give the "
                f"overrides that it was made with, or use its plab {versions}"
            )
    return found


def _verdict(entry: Entry, played: Mapping[str, tuple[float, str]]) -> Verdict:
    if not played:
        return Verdict(entry, {}, NOT_RUN, f"{entry.policy} was not run; --run-policies runs it")
    scores = {precision: score for precision, (score, _) in played.items()}
    if broken := [f"{precision}: {failure}" for precision, (_, failure) in played.items() if failure]:
        return Verdict(entry, scores, BROKE_OFF, f"{entry.name}: the simulation diverged, {broken[0]}")
    if min(abs(score - entry.score) for score in scores.values()) <= TOLERANCE:
        return Verdict(entry, scores, HOLDS)
    reached = ", ".join(f"{score:.4f} in {precision}" for precision, score in scores.items())
    why = f"{entry.name}: claims {entry.score:.4f}, scores {reached} (tolerance {TOLERANCE})"
    return Verdict(entry, scores, LIES, why)


# ---------------------------------------------------------------------------------------------- simulation


def play(
    cfgs: Sequence[Config], actor: Policy | Sequence[np.ndarray], precision: str, name: str = ""
) -> list[tuple[float, str]]:
    """Simulate plans or a policy in several configurations of one task, in the hard contact model.

    Args:
        cfgs: The configurations.
        actor: A plan, shape [T, A], for each configuration; or a policy.
        precision: ``float32`` or ``float64``; observations are float32 in both.
        name: Name of the policy in messages.

    Returns:
        Score of each episode's last state, and an empty text; after a divergence NaN and the reason.

    Raises:
        SubmissionError: If a plan has a wrong shape, or the policy cannot be run, returns invalid actions, or
            is not deterministic.
    """
    played: list[tuple[float, str]] = []
    for start in range(0, len(cfgs), _BATCH):
        some = cfgs[start : start + _BATCH]
        batch = EpisodeBatch([replace(cfg, sim=replace(cfg.sim, precision=precision)) for cfg in some])
        observations, _ = batch.reset()
        (components,) = batch.action_space.shape or (0,)
        if callable(actor):
            _check_policy(actor, observations, name, components)
        else:
            plans = _stacked(some, actor[start : start + _BATCH], [batch.horizon, components])
        for t in range(batch.horizon):
            actions = actor(observations) if callable(actor) else plans[:, t]
            step = batch.step(actions, strict=False)
            observations = step.observation
        batch.close()
        for n, score in enumerate(step.info["score"]):
            failure = step.failures.get(n, "")
            played.append((math.nan if failure else float(score), failure))
    return played


def _stacked(cfgs: Sequence[Config], plans: Sequence[np.ndarray], shape: list[int]) -> np.ndarray:
    for cfg, plan in zip(cfgs, plans, strict=True):
        if list(plan.shape) != shape:
            where = f"{cfg.task.name}-v{cfg.variant}"
            raise SubmissionError(f"{where}: the plan has shape {list(plan.shape)}, its task takes {shape}")
    return np.stack(plans)


def _check_policy(policy: Policy, observations: np.ndarray, name: str, components: int) -> None:
    actions = policy(observations)
    if actions.shape[1] != components:
        given = f"{name} gives actions of {actions.shape[1]} components"
        raise SubmissionError(f"{given}, its task takes {components}")
    if not np.array_equal(actions, policy(observations)):
        raise SubmissionError(f"{name} is not deterministic: one observation has two answers")


def load_policy(name: str, content: bytes) -> Policy:
    """Load a policy, TorchScript (``.pt``) or ONNX (``.onnx``) according to its suffix.

    It returns one finite action in [-1, 1] per observation, or raises SubmissionError.

    Raises:
        SubmissionError: If it cannot be loaded, or ONNX Runtime is missing.
    """
    if name.endswith(".onnx") and find_spec("onnxruntime") is None:
        raise SubmissionError(f"{name} needs ONNX Runtime: pip install 'plab[onnx]'")
    try:
        policy = (_torchscript if name.endswith(".pt") else _onnx)(content)
    # PyTorch, ONNX Runtime and the policy's own code raise errors of any class; likewise below.
    except Exception as error:
        raise SubmissionError(f"{name} cannot be loaded ({_reason(error)})") from None

    def answer(observations: np.ndarray) -> np.ndarray:
        try:
            actions = np.asarray(policy(observations), np.float64)
        except Exception as error:
            raise SubmissionError(f"{name} cannot be run ({_reason(error)})") from None
        if actions.ndim != 2 or len(actions) != len(observations):
            raise SubmissionError(f"{name} gives actions of shape {list(actions.shape)}, not [batch, action]")
        if not np.isfinite(actions).all():
            raise SubmissionError(f"{name} gives actions that are not finite")
        return np.clip(actions, -1.0, 1.0)

    return answer


def _torchscript(content: bytes) -> Policy:
    import torch

    module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()

    def policy(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return module(torch.from_numpy(observations)).numpy()

    return policy


def _onnx(content: bytes) -> Policy:
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (given,) = session.get_inputs()
    return lambda observations: session.run(None, {given.name: observations})[0]


def _reason(error: Exception) -> str:
    """Return the last line of an error's message, which has the reason in PyTorch."""
    return (str(error).strip() or type(error).__name__).splitlines()[-1].strip()[:200]


# ------------------------------------------------------------------------------------------------------ files


def verification_path(submission: Path) -> Path:
    """Return the path of a submission's verification file."""
    return submission.with_name(submission.name.removesuffix(SUFFIX) + ".verified.json")


def write_verification(verification: Verification, submission: Path) -> Path:
    """Write the verification file of a submission; return its path.

    Raises:
        plab.results.ResultsError: If it cannot be written.
    """
    path = verification_path(submission)
    verdicts = [
        {"name": one.entry.name, "claimed": one.entry.score, "scores": one.scores}
        | {"outcome": one.outcome, "why": one.why}
        for one in verification.verdicts
    ]
    record = {"submission": verification.digest, "plab": plab.__version__, "physics": PHYSICS_VERSION}
    record |= {"overrides": list(verification.overrides), "tolerance": TOLERANCE, "time": now()}
    replace_file(path, json.dumps(record | {"entries": verdicts}, indent=1) + "\n")
    return path


def read_verification(submission: Submission) -> Verification | None:
    """Return the verification of a submission; None if this file was not verified with the current physics.

    Raises:
        plab.results.ResultsError: If the verification file cannot be read.
    """
    if submission.path is None or not (path := verification_path(submission.path)).exists():
        return None
    with explained(path):
        record = json.loads(path.read_bytes())
        if record["submission"] != submission.digest or record["physics"] != PHYSICS_VERSION:
            return None
        pairs = zip(submission.entries, record["entries"], strict=True)
        verdicts = tuple(Verdict(entry, own["scores"], own["outcome"], own["why"]) for entry, own in pairs)
        return Verification(submission.digest, verdicts, tuple(record["overrides"]))
