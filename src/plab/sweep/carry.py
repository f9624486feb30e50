"""Carrying out a sweep: what is left to do, who does it, and how each run ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from plab import runners
from plab.config import Config
from plab.outcomes import Outcome
from plab.results import ResultsError, RunFile, read, result_path
from plab.results.locks import held, lock_path
from plab.results.schema import PARTIAL_SUFFIX
from plab.runners.jobs import outcome
from plab.runners.simulator_cache import SimulatorCache
from plab.sweep.plan import plan

__all__ = ["BatchTask", "Carrier", "carry_here", "look_up", "run_sweep"]

Carrier = Callable[[list[list["Config"]], Callable[[], str]], Iterator[Outcome]]
"""Carries out batches: takes them and a function that says how far the sweep has come, yields outcomes."""


def run_sweep(
    cfgs: Sequence[Config], carry: Carrier, size: int | None = None, processes: int = 1, sharing: int = 1
) -> Iterator[Outcome]:
    """Carry out the runs of a sweep that are not finished, in batches of at most ``size``, or as many as
    fit the memory, ``processes`` at a time, of which ``sharing`` use one device, and yield how each
    ended. Runs that another process computes are left to it. Should it end before they do, they are taken up
    here."""
    # The same run given twice is one run.
    wanted = {result_path(cfg): cfg for cfg in cfgs}
    ended: dict[str, Outcome] = {}
    todo = []
    for cfg in wanted.values():
        done = None if cfg.force else _finished_before(cfg)
        if done is None:
            todo.append(cfg)
        else:
            ended[done.path] = done
            yield done
    if ended:
        print(f"{len(ended)} of {len(wanted)} runs finished before", flush=True)

    def progress() -> str:
        return f"[{len(ended)}/{len(wanted)} runs] "

    while todo:
        away = []
        for one in carry(plan(todo, size, processes, sharing), progress):
            if one.status == "elsewhere":
                away.append(one)
            else:
                ended[one.path] = one
                yield one
        by_path = {str(result_path(cfg)): cfg for cfg in todo}
        todo = []
        for one in away:
            if held(one.path):
                yield one
            else:
                todo.append(by_path[one.path])


def carry_here(batches: list[list[Config]], progress: Callable[[], str]) -> Iterator[Outcome]:
    """Carry out batches in this process, one after the other."""
    cache = SimulatorCache()
    for batch in batches:
        yield from runners.run_batch(batch, progress(), cache)


class BatchTask:
    """What a job of another launcher does: its number's batch, or, of a single run, the batch of that."""

    def __init__(self, batches: Sequence[Sequence[Config]]) -> None:
        self._batches = batches

    def __call__(self, _composed: DictConfig) -> list[Outcome]:
        """Carry out the batch of Hydra's job number; called in the job's process."""
        number = HydraConfig.get().job.num
        note = f"[batch {number + 1}/{len(self._batches)}] " if len(self._batches) > 1 else ""
        return runners.run_batch(self._batches[number], note, SimulatorCache())


def look_up(cfg: Config) -> Outcome:
    """Say from its files how a run ended whose process cannot say it any more."""
    path = result_path(cfg)
    if (done := _finished_before(cfg)) is not None:
        return outcome(cfg, "finished", done.score)
    if held(path):
        return outcome(cfg, "elsewhere", message=f"{path} is being computed by another process")
    try:
        left = read(path.with_suffix(PARTIAL_SUFFIX))
    except ResultsError:
        return outcome(cfg, "lost", message="no result, and no process computes it now")
    if left.status == "failed":
        return outcome(cfg, "failed", message=left.message)
    return outcome(cfg, "lost", message=f"{left.rows} iterations, and no process computes it now")


def _finished_before(cfg: Config) -> Outcome | None:
    """Return the outcome of a run whose result is there."""
    path = result_path(cfg)
    try:
        # Where there is something left of a process that was killed, RunFile clears it up.
        left = path.exists() and any(
            one.exists() for one in (lock_path(path), path.with_suffix(PARTIAL_SUFFIX))
        )
        result = RunFile(cfg).result if left else read(path)
    except ResultsError:
        return None
    if result.status != "finished":
        return None
    return outcome(cfg, "before", result.score)
