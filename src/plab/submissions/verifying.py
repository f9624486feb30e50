"""Verification of submissions: every claim is simulated again, in float32 and in float64.

Policies are TorchScript or ONNX. Loading one executes it, hence only where that was asked for.
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
from typing import Any, TypeAlias

import numpy as np

import plab
from plab.config import Config
from plab.envs.core import EpisodeBatch
from plab.files import one_line
from plab.results.provenance import now
from plab.results.run_file import replace_file
from plab.scenes import PRECISIONS
from plab.submissions.submission import (
    SUFFIX,
    Configuration,
    Digests,
    Entry,
    Submission,
    SubmissionError,
    is_share,
)
from plab.targets.store import PHYSICS_VERSION

TOLERANCE = 0.02
"""Largest difference between a claimed score and the simulated one: on the CPU the same actions give the same
bits, on CUDA the last digits vary and contact magnifies them."""

HOLDS, LIES, BROKE_OFF, NOT_RUN = "holds", "does not hold", "broke off", "not run"

_BATCH = 25
"""Maximum number of configurations in one simulator."""

Policy: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Function of observations, float32, shape [batch, entry], that returns actions, shape [batch, action]."""


@dataclass(frozen=True)
class Played:
    """Score of an episode's last state, NaN if it broke off, and the failure."""

    score: float
    failure: str = ""


@dataclass(frozen=True)
class Verdict:
    """Outcome of a claim.

    Attributes:
        entry: The claim.
        scores: Simulated score by precision; empty if it was not run.
        outcome: ``holds``, ``does not hold``, ``broke off`` or ``not run``.
        why: A line, unless it holds.
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
        overrides: Overrides that it was simulated with.
    """

    digest: str
    verdicts: tuple[Verdict, ...]
    overrides: tuple[str, ...]

    @property
    def outcomes(self) -> set[str]:
        """All outcomes that occur."""
        return {verdict.outcome for verdict in self.verdicts}


def verify(
    submission: Submission,
    overrides: Sequence[str] = (),
    *,
    run_policies: bool = False,
    precisions: Sequence[str] = PRECISIONS,
) -> Verification:
    """Simulate all of a submission again, with overrides such as ``sim.device=cuda``, in some precisions.

    The policies in it are other people's programs, and executed with ``run_policies`` only.

    Raises:
        SubmissionError: If it is of other physics, scenes or targets than these, or its plans or policies
            are not for their tasks.
        plab.config.ConfigError: If an override does not fit.
    """
    given = tuple(overrides)
    cfgs = _configs(submission, given)
    scores: dict[int, dict[str, Played]] = defaultdict(dict)
    # Each group is what one simulator can play.
    alike: dict[Any, list[int]] = defaultdict(list)
    for number, entry in enumerate(submission.entries):
        configuration = entry.configuration
        if run_policies or not entry.policy:
            alike[configuration.task, configuration.targets, configuration.terms, entry.policy].append(number)
    policies = {name: load_policy(name, submission.policies[name]) for *_, name in alike if name}
    # Going from one precision to the other starts Taichi anew.
    for precision in precisions:
        for (*_, name), numbers in alike.items():
            entries = [submission.entries[number] for number in numbers]
            chosen = [cfgs[entry.configuration] for entry in entries]
            plans = [entry.actions for entry in entries if entry.actions is not None]
            actor = policies[name] if name else plans
            for number, one in zip(numbers, play(chosen, actor, precision, name), strict=True):
                scores[number][precision] = one
    verdicts = tuple(_verdict(entry, scores[n]) for n, entry in enumerate(submission.entries))
    return Verification(submission.digest, verdicts, given)


def _configs(submission: Submission, overrides: tuple[str, ...]) -> dict[Configuration, Config]:
    """Compose all configurations, and refuse those that are not what the submission was made for."""
    if submission.physics != PHYSICS_VERSION:
        raise SubmissionError(
            f"{submission.path} is of physics version {submission.physics} (plab {submission.plab}), this "
            f"plab ({plab.__version__}) simulates version {PHYSICS_VERSION}"
        )
    names = {entry.configuration for entry in submission.entries}
    found = {configuration: configuration.config(overrides) for configuration in sorted(names)}
    digests = {configuration: Digests.of(cfg) for configuration, cfg in found.items()}
    for entry in submission.entries:
        configuration = entry.configuration
        for part in ("scene", "target"):
            if getattr(entry.digests, part) != getattr(digests[configuration], part):
                raise SubmissionError(
                    f"{submission.path}: the {part} of {configuration.name} is another one than here: give "
                    f"the overrides that it was made with, or use its plab ({submission.plab}, this is "
                    f"{plab.__version__})"
                )
    return found


def _verdict(entry: Entry, played: Mapping[str, Played]) -> Verdict:
    if not played:
        return Verdict(entry, {}, NOT_RUN, f"{entry.policy} was not run; --run-policies runs it")
    scores = {precision: one.score for precision, one in played.items()}
    if broken := [f"{precision}: {one.failure}" for precision, one in played.items() if one.failure]:
        return Verdict(entry, scores, BROKE_OFF, f"{entry.name}: the simulation broke off, {broken[0]}")
    if min(abs(score - entry.score) for score in scores.values()) <= TOLERANCE:
        return Verdict(entry, scores, HOLDS)
    reached = ", ".join(f"{score:.4f} in {precision}" for precision, score in scores.items())
    why = f"{entry.name}: claims {entry.score:.4f}, scores {reached} (tolerance {TOLERANCE})"
    return Verdict(entry, scores, LIES, why)


# ---------------------------------------------------------------------------------------------- simulation


def play(
    cfgs: Sequence[Config], actor: Policy | Sequence[np.ndarray], precision: str, name: str = ""
) -> list[Played]:
    """Play plans or a policy in several configurations of one task, in the hard contact model.

    Args:
        cfgs: The configurations.
        actor: A plan, shape [T, A], for each configuration; or a policy.
        precision: ``float32`` or ``float64``; observations are float32 in both.
        name: Name of the policy in messages.

    Raises:
        SubmissionError: If a plan has not as many steps or components as its task, or the policy cannot be
            run, gives actions that do not fit, or answers the same observation twice differently.
    """
    played: list[Played] = []
    for start in range(0, len(cfgs), _BATCH):
        some = cfgs[start : start + _BATCH]
        batch = EpisodeBatch([replace(cfg, sim=replace(cfg.sim, precision=precision)) for cfg in some])
        shape = (batch.horizon, *(batch.action_space.shape or ()))
        if callable(actor):
            choose = _by_policy(actor, name, shape[1])
        else:
            choose = _by_plans(some, actor[start : start + _BATCH], shape)
        observations, _ = batch.reset()
        for t in range(batch.horizon):
            step = batch.step(choose(t, observations), strict=False)
            observations = step.observation
        batch.close()
        played += [
            Played(math.nan, step.failures[n]) if n in step.failures else Played(float(score))
            for n, score in enumerate(step.info["score"])
        ]
    return played


Choice: TypeAlias = Callable[[int, np.ndarray], np.ndarray]


def _by_plans(cfgs: Sequence[Config], plans: Sequence[np.ndarray], shape: tuple[int, ...]) -> Choice:
    for cfg, plan in zip(cfgs, plans, strict=True):
        if plan.shape != shape:
            where, has = f"{cfg.task.name}-v{cfg.variant}", list(plan.shape)
            raise SubmissionError(f"{where}: the plan has shape {has}, its task takes {list(shape)}")
    whole = np.stack(plans)
    return lambda t, _: whole[:, t]


def _by_policy(policy: Policy, name: str, components: int) -> Choice:
    def choose(t: int, observations: np.ndarray) -> np.ndarray:
        actions = policy(observations)
        if actions.shape[1] != components:
            given = f"{name} gives actions of {actions.shape[1]} components"
            raise SubmissionError(f"{given}, its task takes {components}")
        if t == 0 and not np.array_equal(actions, policy(observations)):
            raise SubmissionError(f"{name} is not deterministic: one observation has two answers")
        return actions

    return choose


def load_policy(name: str, content: bytes) -> Policy:
    """Load a policy, TorchScript (``.pt``) or ONNX (``.onnx``) by the ending of its file's name.

    It returns as many finite actions as there are observations, in [-1, 1], or raises SubmissionError.

    Raises:
        SubmissionError: If it cannot be loaded, or ONNX Runtime is missing.
    """
    policy = (_torchscript if name.endswith(".pt") else _onnx)(name, content)

    def answer(observations: np.ndarray) -> np.ndarray:
        try:
            actions = np.asarray(policy(observations), np.float64)
        # Whatever its author's code or the runtime raises.
        except Exception as error:
            raise SubmissionError(f"{name} cannot be run ({_first(error)})") from None
        if actions.ndim != 2 or len(actions) != len(observations):
            raise SubmissionError(f"{name} gives actions of shape {list(actions.shape)}, not [batch, action]")
        if not np.isfinite(actions).all():
            raise SubmissionError(f"{name} gives actions that are not finite")
        return np.clip(actions, -1.0, 1.0)

    return answer


def _torchscript(name: str, content: bytes) -> Policy:
    import torch

    try:
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise SubmissionError(f"{name} is no TorchScript module ({_first(error)})") from None

    def policy(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return module(torch.from_numpy(observations)).numpy()

    return policy


def _onnx(name: str, content: bytes) -> Policy:
    if find_spec("onnxruntime") is None:
        raise SubmissionError(f"{name} needs ONNX Runtime: pip install 'plab[onnx]'")
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        (given,) = session.get_inputs()
    # ONNX Runtime has exceptions of its own, each derived from Exception alone.
    except Exception as error:
        raise SubmissionError(f"{name} is no ONNX model of one input ({_first(error)})") from None
    return lambda observations: session.run(None, {given.name: observations})[0]


def _first(error: Exception) -> str:
    """Return the last line of an error's message: PyTorch puts the reason there, below its trace."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__


# ------------------------------------------------------------------------------------------------------ files


def verification_path(submission: Path) -> Path:
    """Return the file beside a submission that keeps its verification."""
    return submission.with_name(submission.name.removesuffix(SUFFIX) + ".verified.json")


def write_verification(verification: Verification, submission: Path) -> Path:
    """Write a verification beside its submission; return the file.

    Raises:
        plab.results.ResultsError: If it cannot be written.
    """
    path = verification_path(submission)
    record = {
        "submission": verification.digest,
        "plab": plab.__version__,
        "physics": PHYSICS_VERSION,
        "overrides": list(verification.overrides),
        "tolerance": TOLERANCE,
        "time": now(),
        "entries": [
            {
                "name": verdict.entry.name,
                "claimed": verdict.entry.score,
                "scores": {name: None if math.isnan(v) else v for name, v in verdict.scores.items()},
                "outcome": verdict.outcome,
                "why": verdict.why,
            }
            for verdict in verification.verdicts
        ],
    }
    replace_file(path, (json.dumps(record, indent=1) + "\n").encode(), sync=False)
    return path


def read_verification(submission: Submission) -> Verification | None:
    """Return the verification of a submission; None if this very file was not verified with these physics.

    Raises:
        SubmissionError: If the file beside it cannot be read.
    """
    if submission.path is None:
        return None
    path = verification_path(submission.path)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["submission"] != submission.digest or record["physics"] != PHYSICS_VERSION:
            return None
        verdicts = tuple(
            _kept(entry, own) for entry, own in zip(submission.entries, record["entries"], strict=True)
        )
        return Verification(record["submission"], verdicts, tuple(map(str, record["overrides"])))
    except FileNotFoundError:
        return None
    except (OSError, LookupError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise SubmissionError(
            f"{path} cannot be read ({one_line(error)}): verify the submission again"
        ) from None


def _kept(entry: Entry, record: Any) -> Verdict:
    """Return a verdict that was read from a file; raise ValueError if a value is wrong."""
    scores = {name: value for name, value in record["scores"].items() if name in PRECISIONS}
    if not all(value is None or is_share(value) for value in scores.values()):
        raise ValueError("a score is not in [0, 1]")
    outcome, why = record["outcome"], record["why"]
    if outcome not in (HOLDS, LIES, BROKE_OFF, NOT_RUN) or not (isinstance(why, str) and why.isprintable()):
        raise ValueError("an outcome is unknown")
    numbers = {name: math.nan if value is None else float(value) for name, value in scores.items()}
    return Verdict(entry, numbers, outcome, why)
