"""What submissions really score: every claim is simulated again, in float32 and in float64."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import plab
from plab.config import Config
from plab.results.provenance import now
from plab.results.run_file import replace_file
from plab.scenes import PRECISIONS
from plab.submissions.playing import Played, play_plans, play_policy
from plab.submissions.policies import load
from plab.submissions.schema import SUFFIX, Configuration, Digests, Entry, Submission, SubmissionError
from plab.targets.store import PHYSICS_VERSION

__all__ = ["TOLERANCE", "Verdict", "Verification", "read_verification", "verify", "write_verification"]

TOLERANCE = 0.02
"""How far a claimed score may be from what is simulated: on the CPU the same actions give the same bits, on
CUDA the last digits vary and contact magnifies them."""

HOLDS, LIES, BROKE_OFF, NOT_RUN = "holds", "does not hold", "broke off", "not run"


@dataclass(frozen=True)
class Verdict:
    """What became of a claim.

    Attributes:
        entry: The claim.
        scores: What it really scores, by precision; empty if it was not run.
        outcome: ``holds``, ``does not hold``, ``broke off`` or ``not run``.
        why: A line, unless it holds.
    """

    entry: Entry
    scores: Mapping[str, float]
    outcome: str
    why: str = ""


@dataclass(frozen=True)
class Verification:
    """What became of all claims of a file.

    Attributes:
        digest: SHA-256 of the submission, in hex.
        verdicts: A verdict for each entry, in the order of the file.
        overrides: The overrides that it was simulated with.
    """

    digest: str
    verdicts: tuple[Verdict, ...]
    overrides: tuple[str, ...]

    @property
    def outcomes(self) -> set[str]:
        """Which outcomes there are."""
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
    policies = {name: load(name, submission.policies[name]) for *_, name in alike if name}
    # Going from one precision to the other starts Taichi anew.
    for precision in precisions:
        for (*_, name), numbers in alike.items():
            entries = [submission.entries[number] for number in numbers]
            chosen = [cfgs[entry.configuration] for entry in entries]
            if name:
                played = play_policy(chosen, policies[name], name, precision)
            else:
                plans = [entry.actions for entry in entries if entry.actions is not None]
                played = play_plans(chosen, plans, precision)
            for number, one in zip(numbers, played, strict=True):
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
    found: dict[Configuration, Config] = {}
    digests: dict[Configuration, Digests] = {}
    for entry in submission.entries:
        configuration = entry.configuration
        if configuration not in found:
            found[configuration] = configuration.config(overrides)
            digests[configuration] = Digests.of(found[configuration])
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


# ------------------------------------------------------------------------------------------------------ files


def verification_path(submission: Path) -> Path:
    """Return the file that keeps what became of a submission, beside it."""
    return submission.with_name(submission.name.removesuffix(SUFFIX) + ".verified.json")


def write_verification(verification: Verification, submission: Path) -> Path:
    """Write what became of a submission beside it; return the file.

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
    """Return what became of a submission, None if nobody has verified this very file with these physics.

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
            Verdict(
                entry,
                {name: math.nan if v is None else float(v) for name, v in own["scores"].items()},
                own["outcome"],
                own["why"],
            )
            for entry, own in zip(submission.entries, record["entries"], strict=True)
        )
        return Verification(record["submission"], verdicts, tuple(record["overrides"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SubmissionError(f"{path} cannot be read ({error}): verify the submission again") from None
