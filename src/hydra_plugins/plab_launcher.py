"""Hydra's side of plab's sweeps: a launcher that runs jobs in batches, and the sweeper that goes with it.

Hydra looks for plugins in this namespace package and imports all it finds at every start, so that everything
else is imported when it is needed.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

if TYPE_CHECKING:
    from plab.config import Config
    from plab.tally import Outcome

__all__ = ["BatchLauncher", "BatchSweeper"]


class BatchSweeper(BasicSweeper):
    """Makes the jobs of a sweep as Hydra's own sweeper does, and leaves nothing in the folder but results.

    Hydra's own writes its settings there first, which a sweep that has finished on a disk that is read-only
    by now cannot, and checks all jobs, which :class:`BatchLauncher` does much faster.
    """

    def sweep(self, arguments: list[str]) -> list[Sequence[JobReturn]]:
        """Launch all jobs; see :meth:`hydra.plugins.sweeper.Sweeper.sweep`."""
        from plab.results.files import make_folder, remove_folders

        assert self.config is not None and self.launcher is not None and self.hydra_context is not None
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = parser.parse_overrides([*self._parse_config(), *arguments])
        # A folder that cannot be made is told before anything else.
        made = make_folder(Path(self.config.hydra.sweep.dir))
        returns: list[Sequence[JobReturn]] = []
        try:
            for batch in self.split_arguments(overrides, self.max_batch_size):
                first = sum(len(earlier) for earlier in returns)
                returns.append(self.launcher.launch(batch, initial_job_idx=first))
                for job in returns[-1]:
                    # Raises what went wrong in a job of another launcher.
                    _ = job.return_value
        finally:
            remove_folders(made)
        return returns


class BatchLauncher(Launcher):
    """Runs the jobs of a sweep in batches that share a simulator.

    How they ended is noted in the :class:`plab.tally.Tally` that the task function has as ``tally``:
    Hydra gives a launcher no other way to tell the command line.
    """

    def __init__(self, batch_size: int | None, inner: DictConfig | None, on_gpus: bool) -> None:
        """Keep the settings.

        Args:
            batch_size: Runs of a batch, at most; as many as fit ``sim.memory_mb`` if None.
            inner: Configuration of the launcher that carries out the batches, as jobs of its own; this
                process does if None.
            on_gpus: Whether a process for each GPU does.
        """
        self._size, self._inner, self._on_gpus = batch_size, inner, on_gpus

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra gives to launchers."""
        self._context, self._task, self._config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs; see :meth:`hydra.plugins.launcher.Launcher.launch`."""
        from plab.checks import check_device, check_packages
        from plab.config import ConfigError
        from plab.results import result_path
        from plab.sweep.carry import carry_here, run_sweep
        from plab.sweep.compose import Refused, compose_jobs
        from plab.sweep.gpus import carry_on, gpus
        from plab.tally import Outcome, Tally

        if self._size is not None and self._size < 1:
            raise ConfigError(f"hydra.launcher.batch_size must be at least 1 or null, not {self._size}")
        entries = compose_jobs(job_overrides, self._compose)
        refused = [entry for entry in entries if isinstance(entry, Refused)]
        if len(refused) == len(entries) and len({entry.reason for entry in refused}) == 1:
            # A mistake in what all jobs have in common.
            raise ConfigError(refused[0].reason)
        cfgs = {n: entry for n, entry in enumerate(entries) if not isinstance(entry, Refused)}
        paths = {n: str(result_path(cfg)) for n, cfg in cfgs.items()}
        carry, processes = carry_here, 1
        if self._inner is not None:
            carry = self._carry_elsewhere({paths[n]: job_overrides[n] for n in cfgs})
        else:
            for cfg in cfgs.values():
                check_device(cfg)
                check_packages(cfg)
        if self._on_gpus:
            names = gpus()
            carry, processes = carry_on(names), len(names)
        tally = getattr(self._task, "tally", Tally())
        tally.started = True
        tally.outcomes += [Outcome(" ".join(r.overrides), "", "refused", message=r.reason) for r in refused]
        scores: dict[str, float] = {}
        for one in run_sweep(list(cfgs.values()), carry, self._size, processes):
            tally.outcomes.append(one)
            scores[one.path] = one.score
        return [_job_return(scores[paths[n]] if n in paths else math.nan) for n in range(len(entries))]

    def _compose(self, overrides: list[str]) -> DictConfig:
        return self._context.config_loader.load_sweep_config(self._config, overrides)

    def _carry_elsewhere(
        self, overrides: dict[str, Sequence[str]]
    ) -> Callable[[list[list[Config]], Callable[[], str]], Iterator[Outcome]]:
        """Return what hands batches to the inner launcher, one job each; ``overrides`` are by result file."""
        from plab.plugins import passed_on
        from plab.results import result_path
        from plab.sweep.carry import BatchTask, look_up

        def carry(batches: list[list[Config]], _progress: Callable[[], str]) -> Iterator[Outcome]:
            config = copy.deepcopy(self._config)
            with open_dict(config.hydra):
                config.hydra.launcher = self._inner
            inner = Plugins.instance().instantiate_launcher(
                hydra_context=self._context, task_function=BatchTask(batches), config=config
            )
            # A job composes the configuration of its first run and then computes the whole batch.
            jobs = [overrides[str(result_path(batch[0]))] for batch in batches]
            runs, name = sum(len(batch) for batch in batches), type(inner).__name__
            print(f"{runs} runs go to {name} in {len(batches)} jobs", flush=True)
            try:
                with passed_on():
                    returns = inner.launch(jobs, initial_job_idx=0)
                outcomes = [one for job in returns for one in job.return_value]
            except Exception as error:
                # A job's process was killed, say, or the queue refused the jobs: the files know how far they
                # came.
                print(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:300]}", flush=True)
                outcomes = [look_up(cfg) for batch in batches for cfg in batch]
            yield from outcomes

        return carry


def _job_return(value: Any) -> JobReturn:
    return JobReturn(_return_value=value, status=JobStatus.COMPLETED)
