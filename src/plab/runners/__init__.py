"""Runners: one per family of methods; each turns configurations into result files.

A method's file has the dataclass of its keys, its runner and its record, which the registry
:data:`plab.config.families.FAMILIES` finds. Runs are carried out in batches; a single run is a batch of one.
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from contextlib import suppress

from plab.config import Config
from plab.config.families import FAMILIES, Appearance, Family, Rule, family
from plab.errors import TRACEBACK, ConfigError, traceback_wanted
from plab.outcomes import Outcome
from plab.results import ResultsError, RunBusyError, RunFile
from plab.runners.jobs import USER_ERRORS, Job, RunError, TogetherError, describe, outcome
from plab.runners.runner import Runner, SimulatorCache, Step, Track, measures, shared_problem

__all__ = [
    "FAMILIES",
    "Appearance",
    "Family",
    "Job",
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
    """Run one configuration, unless its result is there already.

    Args:
        cfg: The composed and checked configuration.
        cache: Simulators of earlier runs, for whoever runs several; None: a new one.

    Returns:
        The run's score in [0, 1], as its protocol counts it.

    Raises:
        ResultsError: If the results folder cannot be written, or another process computes the run.
        RunError: If the run broke off; what it computed is kept in the partial file.
    """
    job = Job(cfg, RunFile(cfg))
    before = job.run.finished
    if not before:
        _carry_out([job], "", cache or SimulatorCache())
    if job.error is not None:
        raise job.error
    print(f"{'finished before' if before else 'finished'}: {job.told}, {job.run.path}")
    return job.run.result.score


def run_batch(cfgs: Sequence[Config], note: str = "", cache: SimulatorCache | None = None) -> list[Outcome]:
    """Run configurations that fit together; see :func:`plab.sweep.plan`.

    Runs that have finished before, or that another process computes, are left out.

    Args:
        cfgs: The composed and checked configurations.
        note: How far the sweep has come, shown before the progress.
        cache: Simulators of earlier batches, for whoever runs several; None: a new one.

    Returns:
        How each run ended, in the order of ``cfgs``.
    """
    jobs: dict[int, Job] = {}
    ended: dict[int, Outcome] = {}
    for number, cfg in enumerate(cfgs):
        try:
            jobs[number] = Job(cfg, RunFile(cfg))
        except RunBusyError as error:
            ended[number] = outcome(cfg, "elsewhere", message=str(error))
        except ResultsError as error:
            ended[number] = outcome(cfg, "refused", message=str(error))
    before = {number for number, job in jobs.items() if job.run.finished}
    todo = [job for number, job in jobs.items() if number not in before]
    _carry_out(todo, note, cache or SimulatorCache())
    _print_bugs(todo)
    for number, job in jobs.items():
        ended[number] = one = _outcome(job, "before" if number in before else "finished")
        if one.status == "finished":
            print(f"finished: {job.told}, {one.path}", flush=True)
    return [ended[number] for number in range(len(cfgs))]


def _outcome(job: Job, how: str) -> Outcome:
    if job.error is None:
        return outcome(job.cfg, how, job.run.result.score)
    refused = isinstance(job.error, USER_ERRORS)
    what = str(job.error) if refused or isinstance(job.error, RunError) else describe(job.error)
    if not (refused or isinstance(job.error, RunError) or traceback_wanted()):
        what += f"; a bug: {TRACEBACK}=1 shows where"
    return outcome(job.cfg, "refused" if refused else "failed", message=what)


def _print_bugs(jobs: Sequence[Job]) -> None:
    """Print the traceback of each error that nobody foresaw, once if it ended several runs, if asked to."""
    if not traceback_wanted():
        return
    errors = {id(job.error): job.error for job in jobs if job.error is not None}
    for error in errors.values():
        if not isinstance(error, (RunError, *USER_ERRORS)):
            traceback.print_exception(error)


def _carry_out(jobs: Sequence[Job], note: str, cache: SimulatorCache) -> None:
    """Run jobs of one family to their ends; afterwards each has finished or has an error, and holds no
    lock."""
    party: Sequence[Job] = ()
    try:
        parties = _parties(jobs)
        while parties:
            party = parties.pop(0)
            try:
                _runner_type(party[0])(party, note, cache).run()
            except TogetherError:
                half = len(party) // 2
                parties[:0] = [party[:half], party[half:]]
            except BrokenPipeError:
                raise
            except Exception as error:
                for job in party:
                    if job.open:
                        job.fail(error)
    except (KeyboardInterrupt, BrokenPipeError):
        # Nobody waits for it any more.
        for job in party:
            if job.open:
                # The others are to be closed even if this one's file cannot be written.
                with suppress(ResultsError):
                    job.run.close("stopped", "interrupted")
        raise
    finally:
        for job in jobs:
            job.run.release()


def _parties(jobs: Sequence[Job]) -> list[Sequence[Job]]:
    """Return the jobs that run together; those that cannot run are refused."""
    able = []
    for job in jobs:
        try:
            _runner_type(job)
            able.append(job)
        except Exception as error:
            job.fail(error)
    together = able and family(able[0].cfg.method.family).batching
    return [able] if together else [[job] for job in able]


def _runner_type(job: Job) -> type[Runner]:
    name = job.cfg.method.family
    kind = family(name).runner_type()
    if not issubclass(kind, Runner):
        raise ConfigError(f"the runner of method.family '{name}' is no plab.runners.Runner")
    return kind
