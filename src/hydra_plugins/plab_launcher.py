"""Hydra's side of plab's sweeps: a launcher that runs jobs in batches, and the sweeper that goes with it.

Hydra looks for plugins in this namespace package and imports all it finds at every start, so that everything
else is imported when it is needed.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import Glob
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

if TYPE_CHECKING:
    from plab.config import Config
    from plab.outcomes import Outcome
    from plab.sweep.carry import Carrier

__all__ = ["BatchLauncher", "BatchSweeper"]


class BatchSweeper(BasicSweeper):
    """Counts the jobs of a sweep before it makes them, and leaves nothing in the folder but results.

    Hydra's own writes its settings there first, which a sweep that has finished on a disk that is read-only
    by now cannot, and checks all jobs, which :class:`BatchLauncher` does much faster.
    """

    def __init__(self, max_batch_size: int | None, params: dict[str, Any] | None = None) -> None:
        """Keep the settings: jobs that go to the launcher at a time, at most, all if None, and values of
        keys, as on the command line; ConfigError if they are of the wrong type."""
        from plab.config import ConfigError

        if max_batch_size is not None and (type(max_batch_size) is not int or max_batch_size < 1):
            raise ConfigError(
                f"hydra.sweeper.max_batch_size must be at least 1 or null, not {max_batch_size}"
            )
        if params is not None and not isinstance(params, dict | DictConfig):
            raise ConfigError(f"hydra.sweeper.params must be keys with their values, not {params}")
        super().__init__(max_batch_size, params)

    def _parse_config(self) -> list[str]:
        from plab.config.words import quote_folders

        return quote_folders(super()._parse_config())

    def sweep(self, arguments: list[str]) -> Any:
        """Run the sweep; ConfigError if it has no jobs, or too many."""
        from plab.config import ConfigError
        from plab.config.words import parse, require_few
        from plab.results.run_file import make_folder, remove_folders

        assert self.hydra_context is not None and self.launcher is not None
        loader = self.hydra_context.config_loader
        # As in Hydra's own: what is given last counts.
        given = {one.get_key_element(): one for one in parse([*self._parse_config(), *arguments])}
        for one in given.values():
            one.config_loader = loader
            if isinstance(one.value(), Glob) and not list(one.sweep_string_iterator()):
                raise ConfigError(f"'{one.input_line}' matches nothing: there is nothing to run")
        require_few(list(given.values()))
        assert self.config is not None
        if not self.config.hydra.sweep.dir.strip() and self.config.results_dir.strip():
            raise ConfigError("hydra.sweep.dir is empty: give a folder, or leave it out")
        # A folder that cannot be made is told before anything else.
        made = make_folder(Path(self.config.hydra.sweep.dir or "."))
        done: list[Sequence[JobReturn]] = []
        try:
            for jobs in self.split_arguments(list(given.values()), self.max_batch_size):
                done.append(self.launcher.launch(jobs, initial_job_idx=sum(map(len, done))))
                for job in done[-1]:
                    # Raises what has ended a job of another launcher.
                    _ = job.return_value
        finally:
            remove_folders(made)
        return done


class BatchLauncher(Launcher):
    """Runs the jobs of a sweep in batches that share a simulator.

    How they ended is noted in the :class:`plab.outcomes.Tally` that the task function has as ``tally``:
    Hydra gives a launcher no other way to tell the command line.
    """

    def __init__(self, batch_size: int | None, inner: DictConfig | None, per_gpu: int) -> None:
        """Keep the settings.

        Args:
            batch_size: Runs of a batch, at most; as many as fit ``sim.memory_mb`` if None.
            inner: Configuration of the launcher that carries out the batches, as jobs of its own; this
                process does if None.
            per_gpu: Processes for each GPU that do; none if 0.
        """
        self._size, self._inner, self._per_gpu = batch_size, inner, per_gpu

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra gives to launchers."""
        self._context, self._task, self._config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs; see :meth:`hydra.plugins.launcher.Launcher.launch`."""
        from plab.config import ConfigError
        from plab.sweep.carry import carry_here
        from plab.sweep.gpus import gpus, processes_on

        if self._size is not None and (type(self._size) is not int or self._size < 1):
            raise ConfigError(f"hydra.launcher.batch_size must be at least 1 or null, not {self._size}")
        if type(self._per_gpu) is not int or self._per_gpu < 0:
            raise ConfigError(f"hydra.launcher.per_gpu must be at least 0, not {self._per_gpu}")
        if self._inner is not None and (
            not isinstance(self._inner, DictConfig) or "_target_" not in self._inner
        ):
            raise ConfigError(
                "hydra.launcher.inner has to be a launcher's settings, with its _target_: choose one, as by "
                "hydra/launcher=batch_joblib"
            )
        if not self._per_gpu or self._inner is not None:
            return self._run(job_overrides, carry_here, 1)
        names = gpus()
        with processes_on(names, self._per_gpu, len(job_overrides)) as carry:
            return self._run(job_overrides, carry, len(names) * self._per_gpu)

    def _run(
        self, job_overrides: Sequence[Sequence[str]], carry: Carrier, processes: int
    ) -> Sequence[JobReturn]:
        """Run all jobs, so many batches at a time."""
        from plab.config import ConfigError
        from plab.config.checks import check_device, check_packages
        from plab.outcomes import Outcome, Tally
        from plab.results import result_path
        from plab.sweep.carry import run_sweep
        from plab.sweep.compose import Refused, compose_jobs

        load = self._context.config_loader.load_sweep_config
        entries = compose_jobs(job_overrides, lambda overrides: load(self._config, overrides))
        refused = [entry for entry in entries if isinstance(entry, Refused)]
        if len(refused) == len(entries) and len({entry.reason for entry in refused}) == 1:
            # A mistake in what all jobs have in common.
            raise ConfigError(refused[0].reason)
        cfgs = {n: entry for n, entry in enumerate(entries) if not isinstance(entry, Refused)}
        paths = {n: str(result_path(cfg)) for n, cfg in cfgs.items()}
        if self._inner is not None:
            carry = self._carry_elsewhere({paths[n]: job_overrides[n] for n in cfgs})
            processes = _processes(self._inner)
        else:
            for cfg in cfgs.values():
                check_device(cfg)
                check_packages(cfg)
        tally = getattr(self._task, "tally", Tally())
        tally.started = True
        tally.outcomes += [Outcome(" ".join(r.overrides), "", "refused", message=r.reason) for r in refused]
        scores: dict[str, float] = {}
        for one in run_sweep(list(cfgs.values()), carry, self._size, processes, max(1, self._per_gpu)):
            tally.outcomes.append(one)
            scores[one.path] = one.score
        values = [scores[paths[n]] if n in paths else math.nan for n in range(len(entries))]
        return [JobReturn(_return_value=value, status=JobStatus.COMPLETED) for value in values]

    def _carry_elsewhere(self, overrides: dict[str, Sequence[str]]) -> Carrier:
        """Return what hands batches to the inner launcher, one job each; ``overrides`` are by result file."""
        from plab.errors import tell
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
            alone = "; hydra.launcher.batch_size=1 makes a job of each" if runs > len(batches) == 1 else ""
            print(f"{runs} runs go to {name} in {len(batches)} jobs{alone}", flush=True)
            try:
                with passed_on():
                    returns = inner.launch(jobs, initial_job_idx=0)
                outcomes = [one for job in returns for one in job.return_value]
            except Exception as error:
                # A job's process was killed, say, or the queue refused the jobs: the files know how far they
                # came.
                tell(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:300]}")
                outcomes = [look_up(cfg) for batch in batches for cfg in batch]
            yield from outcomes

        return carry


def _processes(inner: DictConfig) -> int:
    """Return how many processes another launcher starts at a time, as far as its settings tell."""
    wanted = inner.get("n_jobs", 1)
    if type(wanted) is not int or wanted == 0:
        return 1
    # As joblib counts: -1 is one for each core.
    return wanted if wanted > 0 else max(1, (os.cpu_count() or 1) + 1 + wanted)
