"""Entries of submissions from recordings, plab's own results and policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from plab.config import load_config
from plab.config.selection import Selection
from plab.render import RenderError, rollouts
from plab.report.series import load_rows
from plab.results import Row
from plab.results.table import readable_rows
from plab.submissions.submission import (
    SUFFIX,
    Checksums,
    Configuration,
    Entry,
    SubmissionError,
    configuration_of,
    read,
    variant_words,
)
from plab.submissions.verifying import load_policy, play


def submission_files(source: Path) -> list[Path]:
    """Return the submissions or recordings in a folder and its subfolders, or a single file."""
    if source.is_file():
        return [source] if source.name.endswith(SUFFIX) else []
    return sorted(source.rglob(f"*{SUFFIX}"))


def from_sources(sources: Sequence[Path], chosen: Selection) -> list[Entry]:
    """Collect plans from folders of recordings, or from selected runs in folders, files and archives of
    results, sorted by configuration.

    Raises:
        SubmissionError: If there are none, or duplicates.
        plab.results.ResultsError: If a file cannot be read.
    """
    found: dict[Configuration, Path] = {}
    entries: list[Entry] = []
    for source in sources:
        recordings = submission_files(source)
        groups = [(path, list(read(path).entries)) for path in recordings]
        if not recordings:
            rows, unreadable = readable_rows(source)
            if unreadable:
                raise unreadable[0]
            finished = (row for row in rows if row.values["status"] == "finished")
            groups = [(row.path, [_of_run(row)]) for row in finished if chosen(row.values, row.config)]
        for path, own in groups:
            for entry in own:
                other, name = found.setdefault(entry.configuration, path), entry.configuration.name
                if other != path:
                    both = f"{path} and {other} are both of {name}"
                    raise SubmissionError(f"{both}: submit one training of each")
            entries += own
    if not entries:
        raise SubmissionError("there is nothing to submit: no episode has ended, or no finished run fits")
    return sorted(entries, key=lambda entry: entry.configuration)


def _of_run(row: Row) -> Entry:
    """Return the best actions of a run."""
    try:
        cfg, actions = rollouts.stored(row.path)
    except RenderError as error:
        raise SubmissionError(str(error)) from None
    return Entry(
        configuration_of(cfg), Checksums.of(cfg), steps_to_best(row), row.values["score_best"], actions
    )


def steps_to_best(row: Row) -> int:
    """Return the number of environment steps simulated until a run found its best actions."""
    return int(load_rows(row.path)["simulated"][row.values["best_iteration"]])


def from_policies(
    policies: Mapping[str, Path], variants: Sequence[str], steps: int, overrides: Sequence[str]
) -> tuple[list[Entry], dict[str, bytes]]:
    """Run policies, and collect their episodes.

    Args:
        policies: Files of TorchScript (``.pt``) or ONNX (``.onnx``), by task. They are executed.
        variants: Variants to act in.
        steps: Environment steps of the training of each policy.
        overrides: Overrides of every configuration.

    Returns:
        The entries, and the files by their names in the submission.

    Raises:
        SubmissionError: If a policy cannot be read or run, or the simulation diverges.
        plab.config.ConfigError: If an override is invalid.
    """
    entries: list[Entry] = []
    files: dict[str, bytes] = {}
    for task, path in policies.items():
        name = f"policies/{task}{path.suffix}"
        try:
            files[name] = path.read_bytes()
        except OSError as error:
            raise SubmissionError(f"cannot read {path}: {error.strerror or error}") from None
        cfgs = [load_config([*variant_words(task, variant), *overrides]) for variant in variants]
        played = play(cfgs, load_policy(name, files[name]), "float32", str(path))
        for cfg, one in zip(cfgs, played, strict=True):
            configuration = configuration_of(cfg)
            if one.failure:
                raise SubmissionError(f"{configuration.name}: the simulation diverged, {one.failure}")
            entries.append(Entry(configuration, Checksums.of(cfg), steps, one.score, policy=name))
    return entries, files
