"""Verification of submissions by repeated simulation, and sources of their entries: episodes of an agent,
results of plab, and policies.

Policies are TorchScript or ONNX. Loading a policy executes it, so this happens only on request.
"""

from __future__ import annotations

import functools
import io
import json
import math
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np

import plab
from plab.config import Config, ConfigError, build_scene
from plab.config.selection import Selection
from plab.envs.core import EpisodeBatch, Transition
from plab.render import rollouts
from plab.report.statistics import BUDGETS, rows_on_axes
from plab.results import Row, read_curves
from plab.results.run_file import explained, replace_file
from plab.results.run_table import rows
from plab.results.running import now
from plab.submissions.submission import (
    SUFFIX,
    Configuration,
    Entry,
    Submission,
    SubmissionError,
    checksum,
    configuration_of,
    encode,
    read,
    write,
)
from plab.targets.build import PHYSICS_VERSION

TOLERANCE = 0.02
"""Tolerance between claimed and simulated scores. The CPU is bitwise reproducible; on CUDA the last digits
vary, amplified by contact."""

HOLDS, LIES, BROKE_OFF, NOT_RUN = _OUTCOMES = ("holds", "does not hold", "broke off", "not run")

_BATCH = 25
"""Maximum number of configurations in one simulator."""

Policy: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Function of observations, float32, shape [batch, entry], that returns actions, shape [batch, action]."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of verifying a claim.

    Attributes:
        entry: The claim.
        score: Simulated score, NaN if the entry was not run or broke off.
        outcome: ``holds``, ``does not hold``, ``broke off`` or ``not run``.
        why: One-line reason, empty if the claim holds.
    """

    entry: Entry
    score: float
    outcome: str
    why: str = ""


def verify(
    submission: Submission, overrides: Sequence[str] = (), *, run_policies: bool = False
) -> list[Verdict]:
    """Simulate all entries of a submission again, with overrides such as ``sim.device=cuda``.

    Its policies are programs from others, executed only with ``run_policies``.

    Returns:
        A verdict for each entry, in the order of the file.

    Raises:
        SubmissionError: If physics, scenes or targets differ, or plans do not fit their tasks.
        plab.config.ConfigError: If an override is invalid, or ONNX Runtime is missing.
    """
    cfgs = configs_of(submission, overrides)
    # Each group fits into one simulator.
    alike: dict[tuple[str, str], list[Entry]] = defaultdict(list)
    for entry in submission.entries:
        if run_policies or not entry.policy:
            alike[entry.configuration.task, entry.policy].append(entry)
    verdicts: dict[int, Verdict] = {}
    for (_, name), entries in alike.items():
        chosen = [cfgs[entry.configuration] for entry in entries]
        plans = [entry.actions for entry in entries if entry.actions is not None]
        try:
            played = play(chosen, load_policy(name, submission.policies[name]) if name else plans, name)
        except SubmissionError as error:
            # None of the claims of a policy that cannot be run holds.
            verdicts |= {id(entry): Verdict(entry, math.nan, BROKE_OFF, str(error)) for entry in entries}
            continue
        for entry, (score, failure) in zip(entries, played, strict=True):
            claim = f"{entry.name}: claims {entry.score:.4f}, scores {score:.4f}"
            outcome, why = LIES, f"{claim} (tolerance {TOLERANCE})"
            if failure:
                outcome, why = BROKE_OFF, f"{entry.name}: the simulation diverged, {failure}"
            elif abs(score - entry.score) <= TOLERANCE:
                outcome, why = HOLDS, ""
            verdicts[id(entry)] = Verdict(entry, score, outcome, why)
    why = "policies were not run; --run-policies runs them"
    return [verdicts.get(id(one), Verdict(one, math.nan, NOT_RUN, why)) for one in submission.entries]


def configs_of(submission: Submission, overrides: Sequence[str]) -> dict[Configuration, Config]:
    """Compose the configurations of a submission.

    Raises:
        SubmissionError: If the physics, a scene or a target differs from this plab's with the overrides, or a
            plan does not fit its task.
        plab.config.ConfigError: If an override is invalid.
    """
    versions = f"({submission.plab}, this is {plab.__version__})"
    if submission.physics != PHYSICS_VERSION:
        raise SubmissionError(
            f"{submission.path} is of physics version {submission.physics}, this plab simulates version "
            f"{PHYSICS_VERSION}: use its plab {versions}"
        )
    found: dict[Configuration, Config] = {}
    for entry in submission.entries:
        found[entry.configuration], known, shape = _composed(entry.configuration, tuple(overrides))
        if entry.checksum != known:
            raise SubmissionError(
                f"{submission.path}: the scene or target of {entry.configuration.name} differs from "
                f"the one here: use the overrides that it was made with, or its plab {versions}"
            )
        if entry.actions is not None and entry.actions.shape != shape:
            given = f"the plan has shape {list(entry.actions.shape)}, but its task needs {list(shape)}"
            raise SubmissionError(f"{submission.path}: {entry.configuration.name}: {given}")
    return found


@functools.cache
def _composed(one: Configuration, overrides: tuple[str, ...]) -> tuple[Config, str, tuple[int, int]]:
    cfg = one.config(overrides)
    return cfg, checksum(cfg), (cfg.sim.horizon, build_scene(cfg).action_dim)


# ---------------------------------------------------------------------------------------------- simulation


def play(
    cfgs: Sequence[Config], actor: Policy | Sequence[np.ndarray], name: str = ""
) -> list[tuple[float, str]]:
    """Simulate plans or a policy in several configurations of one task, in the hard contact model.

    Args:
        cfgs: The configurations.
        actor: A plan, shape [T, A], for each configuration; or a policy.
        name: Name of the policy in messages.

    Returns:
        Score of each episode's last state, and an empty string; after a divergence NaN and the reason.

    Raises:
        SubmissionError: If the policy cannot be run, returns invalid actions, or is not deterministic.
    """
    played: list[tuple[float, str]] = []
    for start in range(0, len(cfgs), _BATCH):
        some = cfgs[start : start + _BATCH]
        batch = EpisodeBatch(some)
        observations, _ = batch.reset()
        (components,) = batch.action_space.shape or (0,)
        if callable(actor):
            actions = actor(observations)
            if actions.shape[1] != components:
                given = f"{name} gives actions of {actions.shape[1]} components"
                raise SubmissionError(f"{given}, but its task has {components}")
            if not np.array_equal(actions, actor(observations)):
                raise SubmissionError(f"{name} is not deterministic: actions for one observation differ")
        for t in range(batch.horizon):
            if callable(actor):
                actions = actor(observations)
            else:
                actions = np.stack([plan[t] for plan in actor[start : start + _BATCH]])
            step = batch.step(actions, strict=False)
            observations = step.observation
        batch.close()
        for n, score in enumerate(step.info["score"]):
            failure = step.failures.get(n, "")
            played.append((math.nan if failure else float(score), failure))
    return played


def load_policy(name: str, content: bytes) -> Policy:
    """Load a policy, TorchScript (``.pt``) or ONNX (``.onnx``) according to its suffix.

    The policy returns one finite action in [-1, 1] per observation, or raises SubmissionError.

    Raises:
        SubmissionError: If the policy cannot be loaded.
        plab.config.ConfigError: If ONNX Runtime is missing.
    """
    if name.endswith(".onnx") and find_spec("onnxruntime") is None:
        raise ConfigError(f"{name} needs ONNX Runtime: pip install 'plab[onnx]'")
    try:
        if name.endswith(".pt"):
            import torch

            module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
            policy: Policy = torch.no_grad()(lambda seen: module(torch.from_numpy(seen)).numpy())
        else:
            import onnxruntime

            session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
            (given,) = session.get_inputs()
            policy = lambda seen: session.run(None, {given.name: seen})[0]  # noqa: E731
    # PyTorch, ONNX Runtime and the policy's own code raise errors of any class; likewise below.
    except Exception as error:
        raise SubmissionError(f"{name} cannot be loaded ({_reason(error)})") from None

    def answer(observations: np.ndarray) -> np.ndarray:
        try:
            actions = np.asarray(policy(observations), np.float64)
        except Exception as error:
            raise SubmissionError(f"{name} cannot be run ({_reason(error)})") from None
        if actions.ndim != 2 or len(actions) != len(observations) or not np.isfinite(actions).all():
            raise SubmissionError(f"{name} must return finite actions of shape [batch, action]")
        return np.clip(actions, -1.0, 1.0)

    return answer


def _reason(error: Exception) -> str:
    """Return the last line of an error's message, which has the reason in PyTorch."""
    return (str(error).strip() or type(error).__name__).splitlines()[-1].strip()[:200]


# ----------------------------------------------------------------------------------------------------- files


def _beside(submission: Submission) -> Path:
    """Return the verification file of a submission that was read from a file."""
    path = cast(Path, submission.path)
    return path.with_name(path.name.removesuffix(SUFFIX) + ".verified.json")


def write_verification(verdicts: Sequence[Verdict], submission: Submission, overrides: Sequence[str]) -> Path:
    """Write the verification file beside a submission; return its path.

    Raises:
        plab.results.ResultsError: If the file cannot be written.
    """
    path = _beside(submission)
    entries = [
        {"name": one.entry.name, "claimed": one.entry.score, "score": one.score}
        | {"outcome": one.outcome, "why": one.why}
        for one in verdicts
    ]
    record = {"submission": submission.digest, "plab": plab.__version__, "physics": PHYSICS_VERSION}
    record |= {"overrides": list(overrides), "tolerance": TOLERANCE, "time": now()}
    replace_file(path, json.dumps(record | {"entries": entries}, indent=1) + "\n")
    return path


def read_verification(submission: Submission) -> list[Verdict]:
    """Return the verdicts on a submission, or none if its file was not verified with the current physics.

    Raises:
        plab.results.ResultsError: If the verification file cannot be read.
    """
    path = _beside(submission)
    if not path.exists():
        return []
    with explained(path):
        record = json.loads(path.read_bytes())
        if record["submission"] != submission.digest or record["physics"] != PHYSICS_VERSION:
            return []
        pairs = zip(submission.entries, record["entries"], strict=True)
        verdicts = [Verdict(entry, own["score"], own["outcome"], str(own["why"])) for entry, own in pairs]
        for one in verdicts:
            scored = type(one.score) is float and (0.0 <= one.score <= 1.0 or math.isnan(one.score))
            if not scored or one.outcome not in _OUTCOMES or (one.outcome == HOLDS and math.isnan(one.score)):
                raise ValueError(f"{one.entry.name}: {one.outcome!r:.60}, score {one.score!r:.60}")
        return verdicts


# ------------------------------------------------------------------------------------------------ recordings

_ledgers: dict[Path, _BestEpisodes] = {}
"""Recordings of this process by file; environments of one configuration share one, with a common count of
steps."""

Env = TypeVar("Env")


class _BestEpisodes:
    """Best episodes of one configuration, one per budget, in a file.

    Attributes:
        steps: Environment steps simulated so far.
    """

    def __init__(self, cfg: Config, path: Path) -> None:
        """Create the file.

        Raises:
            SubmissionError: If the file exists.
            OSError: If it cannot be written.
        """
        self.steps = 0
        self._configuration = configuration_of(cfg)
        self._checksum = checksum(cfg)
        self._best: dict[float, Entry] = {}
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Created empty, so that two processes cannot both create it.
            with path.open("xb") as file:
                file.write(encode(Submission(None, ())))
        except FileExistsError:
            raise SubmissionError(f"{path} exists: record into another folder, or remove it") from None

    def add(self, actions: np.ndarray, score: float) -> None:
        """Add an episode, given its actions, shape [T, A], and score."""
        better = [
            limit
            for limit in (*BUDGETS, math.inf)
            if self.steps <= limit and (limit not in self._best or score > self._best[limit].score)
        ]
        if not better:
            return
        entry = Entry(self._configuration, self._checksum, self.steps, score, np.clip(actions, -1.0, 1.0))
        self._best |= dict.fromkeys(better, entry)
        kept = {best.steps: best for best in self._best.values()}
        write(Submission(None, tuple(kept[steps] for steps in sorted(kept))), self._path)


def record(env: Env, folder: str | Path) -> Env:
    """Record the episodes of an agent, for ``plab submit``: ``record(make("plab/Move-v1"), "recordings")``.

    For each configuration, a file in ``folder`` contains the actions of the best episode within each budget
    of :data:`plab.report.statistics.BUDGETS` and overall, with the environment steps simulated until then.
    All environments of one configuration in a process share it. It is written whenever an episode improves;
    the steps of abandoned episodes count. Randomised episodes are left out with a warning, because
    verification simulates the task as configured; only their steps count.

    Args:
        env: A single or vector environment of plab in the hard contact model, with any wrappers.
        folder: Folder of the recordings, used by this training only.

    Returns:
        The same environment.

    Raises:
        SubmissionError: If the environment cannot be recorded, or the folder has another process's recording.
        plab.results.ResultsError: If the file cannot be written.
    """
    inner = getattr(env, "unwrapped", None)
    batch = getattr(inner, "batch", None)
    if not isinstance(batch, EpisodeBatch):
        raise SubmissionError(f"{type(inner).__name__} is not a plab environment")
    if batch.contact != "hard":
        raise SubmissionError("the contact model is soft, but scores need the hard one")
    if batch.terminates:
        raise SubmissionError("plans are whole episodes: omit terminate_on_success, which ends them early")
    ledgers = []
    for cfg in batch.configs:
        path = Path(folder).resolve() / f"{configuration_of(cfg).name}{SUFFIX}"
        if path not in _ledgers or not path.exists():
            _ledgers[path] = _BestEpisodes(cfg, path)
        ledgers.append(_ledgers[path])
    taken: deque[np.ndarray] = deque(maxlen=batch.horizon)

    def observe(actions: Any, result: Transition) -> None:
        taken.append(np.array(actions, np.float64))
        for ledger in ledgers:
            ledger.steps += 1
        if not result.truncated.any():
            return
        if "randomized" in result.info:
            rollouts.print_once(
                f"{folder}: randomised episodes are not recorded: evaluate in the task as configured"
            )
            return
        # The last steps of a complete episode are the whole episode.
        episodes = np.stack(taken, axis=1)
        for e in np.flatnonzero(result.truncated):
            if e not in result.failures:
                ledgers[e].add(episodes[e], float(result.info["score"][e]))

    batch.listener = observe
    return env


# --------------------------------------------------------------------------------------- results and policies


def submission_files(source: Path) -> list[Path]:
    """Return the submissions or recordings in a folder and its subfolders, or a single file."""
    if source.is_file():
        return [source] if source.name.endswith(SUFFIX) else []
    return sorted(source.rglob(f"*{SUFFIX}"))


def from_sources(sources: Sequence[Path], chosen: Selection) -> list[Entry]:
    """Collect plans from folders of recordings, or from selected runs in folders, files and archives of
    results, sorted by configuration.

    Raises:
        SubmissionError: If there are no plans, or duplicates.
        plab.results.ResultsError: If a file cannot be read.
    """
    found: dict[Configuration, Path] = {}
    entries: list[Entry] = []
    for source in sources:
        recordings = submission_files(source)
        groups = [(path, list(read(path).entries)) for path in recordings]
        if not recordings:
            runs, unreadable = rows(source)
            if unreadable:
                raise unreadable[0]
            finished = (row for row in runs if row.values["status"] == "finished")
            groups = [(row.path, [_of_run(row)]) for row in finished if chosen(row.values, row.config)]
        for path, own in groups:
            for entry in own:
                other, name = found.setdefault(entry.configuration, path), entry.configuration.name
                if other != path:
                    both = f"{path} and {other} are both for {name}"
                    raise SubmissionError(f"{both}: submit one training of each")
            entries += own
    if not entries:
        raise SubmissionError("there is nothing to submit: no episode has ended, or no finished run matches")
    return sorted(entries, key=lambda entry: entry.configuration)


def _of_run(row: Row) -> Entry:
    """Return the best actions of a run."""
    cfg, actions = rollouts.stored(row.path)
    score = row.values["score_best"]
    (columns,), best = read_curves([row.path]), row.values["best_iteration"]
    steps = int(rows_on_axes(row.config, columns, best)["simulated"][best])
    return Entry(configuration_of(cfg), checksum(cfg), steps, score, actions)


def from_policies(
    policies: Mapping[str, Path], variants: Sequence[str], steps: int, overrides: Sequence[str]
) -> tuple[list[Entry], dict[str, bytes]]:
    """Run policies and collect their episodes.

    Args:
        policies: TorchScript (``.pt``) or ONNX (``.onnx``) files by task. They are executed.
        variants: Variants to run the policies in.
        steps: Environment steps used to train each policy.
        overrides: Overrides for every configuration.

    Returns:
        The entries, and the policy files by name in the submission.

    Raises:
        SubmissionError: If a policy cannot be run, or the simulation diverges.
        OSError: If its file cannot be read.
        plab.config.ConfigError: If an override is invalid.
    """
    entries: list[Entry] = []
    files: dict[str, bytes] = {}
    for task, path in policies.items():
        name = f"policies/{task}{path.suffix}"
        files[name] = path.read_bytes()
        cfgs = [Configuration(task, variant).config(overrides) for variant in variants]
        played = play(cfgs, load_policy(name, files[name]), str(path))
        for cfg, (score, failure) in zip(cfgs, played, strict=True):
            configuration = configuration_of(cfg)
            if failure:
                raise SubmissionError(f"{configuration.name}: the simulation diverged, {failure}")
            entries.append(Entry(configuration, checksum(cfg), steps, score, policy=name))
    return entries, files
