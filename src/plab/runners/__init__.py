"""Runners, one per family of methods, which turn configurations into result files.

The file of a method contains the dataclass of its keys, its runner and its record, registered in
:data:`plab.config.families.FAMILIES`. Runs are executed in batches; a single run is a batch of one.
"""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress

from plab.config import Config
from plab.config.compose import require_configs
from plab.config.families import FAMILIES, Appearance, Family, Rule, family
from plab.errors import ConfigError, PlabError, traceback_wanted
from plab.plugins import load_object
from plab.results import ResultsError, RunBusyError, RunFile
from plab.runners.runner import (
    Outcome,
    RunError,
    Runner,
    SimulatorCache,
    Step,
    TogetherError,
    Track,
    measures,
    shared_problem,
)

__all__ = [
    "FAMILIES",
    "Appearance",
    "Family",
    "Rule",
    "RunError",
    "Runner",
    "SimulatorCache",
    "Step",
    "Track",
    "measures",
    "run_batch",
    "run_config",
    "shared_problem",
]


def run_config(cfg: Config, cache: SimulatorCache | None = None) -> float:
    """Run one configuration unless its result exists.

    Args:
        cfg: The composed and checked configuration.
        cache: Simulators of earlier runs; default: a new cache.

    Returns:
        The run's score under its protocol, in [0, 1].

    Raises:
        ResultsError: If the results folder cannot be written, or another process is computing the run.
        RunError: If the run failed; its results so far are kept in the partial file.
    """
    require_configs([cfg])
    track = Track(cfg, RunFile(cfg))
    _execute([track], "", cache)
    if track.error is not None:
        raise track.error
    before = " before" if track.finished_before else ""
    print(f"finished{before}: score {track.run.result.score:.4f}, {track.run.path}")
    return track.run.result.score


def run_batch(cfgs: Sequence[Config], note: str = "", cache: SimulatorCache | None = None) -> list[Outcome]:
    """Run configurations that can share a batch; see :func:`plab.sweep.execution.plan`.

    Finished runs, and runs in progress in another process, are skipped.

    Args:
        cfgs: The composed and checked configurations.
        note: Progress of the sweep, shown before the progress of the batch.
        cache: Simulators of earlier batches; default: a new cache.

    Returns:
        Outcome of each run, in the order of ``cfgs``.
    """
    ended: list[Outcome | Track] = []
    for cfg in cfgs:
        try:
            ended.append(Track(cfg, RunFile(cfg)))
        except ResultsError as error:
            status = "elsewhere" if isinstance(error, RunBusyError) else "refused"
            ended.append(Outcome.of(cfg, status, message=str(error)))
    todo = [one for one in ended if isinstance(one, Track) and not one.finished_before]
    _execute(todo, note, cache)
    if traceback_wanted():
        # Only once if it ended several runs.
        for error in {id(track.error): track.error for track in todo}.values():
            if error is not None and not isinstance(error, PlabError):
                traceback.print_exception(error)
    for track in todo:
        if track.error is None:
            print(f"finished: score {track.run.result.score:.4f}, {track.run.path}", flush=True)
    return [one.outcome() if isinstance(one, Track) else one for one in ended]


def _execute(tracks: Sequence[Track], note: str, cache: SimulatorCache | None) -> None:
    """Execute unfinished tracks of one family until each has finished or failed and released its lock."""
    cache = cache or SimulatorCache()
    # Executed alone, all together, or with those at the same iteration.
    groups: dict[int, list[Track]] = defaultdict(list)
    for number, track in enumerate(track for track in tracks if track.open):
        own = family(track.cfg.method.family)
        groups[number if not own.batching else track.iteration if own.in_step else 0].append(track)
    parties = [groups[key] for key in sorted(groups)]
    try:
        while parties:
            party = parties.pop(0)
            try:
                name = party[0].cfg.method.family
                kind = family(name).runner
                if isinstance(kind, str):
                    kind = load_object(kind, type)
                if not issubclass(kind, Runner):
                    raise ConfigError(f"the runner of method.family '{name}' is not a plab.runners.Runner")
                kind(party, note, cache).run()
            except TogetherError:
                left = [track for track in party if track.open]
                half = len(left) if len(left) < len(party) else len(left) // 2
                parties[:0] = [part for part in (left[:half], left[half:]) if part]
            except BrokenPipeError:
                raise
            except Exception as error:
                for track in party:
                    if track.open:
                        track.fail(error)
    except (KeyboardInterrupt, BrokenPipeError):
        for track in party:
            if track.open:
                # The other files must be closed even if this one cannot be written.
                with suppress(ResultsError):
                    track.run.close("stopped", "interrupted")
        raise
    finally:
        for track in tracks:
            track.log.close()
            track.run.release()
