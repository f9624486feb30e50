"""Sweeps: composition of all combinations of values, batching, execution and outcomes."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from hydra._internal.callbacks import Callbacks
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, open_dict

from plab import runners
from plab.config import Config, ConfigError, build_scene
from plab.config.compose import check_sources, compose, finish, hydra_app, load_config, require_runnable
from plab.config.families import family
from plab.config.overrides import parse, prepared, swept
from plab.config.selection import OBSERVATION_KEYS
from plab.config.suite import choices
from plab.errors import PlabError, print_error
from plab.plugins import export_module_path
from plab.problem import build_scenes
from plab.results import ResultsError, RunFile, read
from plab.results.run_file import PARTIAL_SUFFIX, row_count
from plab.results.running import held, lock_path
from plab.runners.runner import Outcome, SimulatorCache, report
from plab.scenes import Scene
from plab.sim.batch import scene_kind
from plab.sim.memory import batch_limit, most_environments
from plab.sim.runtime import cuda_devices

VISIBLE = "CUDA_VISIBLE_DEVICES"

Executor = Callable[[list[list[Config]], Callable[[], str]], Iterator[Outcome]]
"""Function that executes batches, given a progress text, and yields outcomes."""


def sweep(words: Sequence[str], master: DictConfig, config_dir: str | None = None) -> int:
    """Run all combinations of the values in overrides, and report the outcomes.

    Args:
        words: Prepared overrides.
        master: Configuration with Hydra's section, which has the parameters of an experiment and the settings
            of the launcher.
        config_dir: Folder with the user's files.

    Returns:
        Exit code: 0 if all results exist, 2 if a run was rejected, otherwise 1.

    Raises:
        ConfigError: If the overrides define no runs, or all runs are rejected for the same reason.
    """
    if not master.hydra.sweeper["_target_"].endswith(".BasicSweeper"):
        raise ConfigError(
            "hydra/sweeper: plab runs all combinations; to search, call plab.runners.run_config in Python"
        )
    settings = _launcher_settings(master.hydra.launcher)
    jobs = jobs_of(words, master.hydra.sweeper.params or {}, config_dir)
    entries = compose_jobs(jobs, config_dir)
    by_path = {str(one.path): job for one, job in zip(entries, jobs, strict=True) if isinstance(one, Config)}
    cfgs = [one for one in entries if isinstance(one, Config)]
    ended = [one for one in entries if isinstance(one, Outcome)]
    if not cfgs and len({one.message for one in ended}) == 1:
        # An error common to all jobs.
        raise ConfigError(ended[0].message)
    execute, processes = execute_batches, 1
    if settings["inner"] is not None:
        execute = partial(_submit_batches, master, settings["inner"], by_path)
        # As in joblib, -1 means one per core.
        wanted = settings["inner"].get("n_jobs", 1)
        processes = wanted if wanted > 0 else max(1, (os.cpu_count() or 1) + 1 + wanted)
    else:
        for cfg in cfgs:
            require_runnable(cfg)
        if settings["per_gpu"]:
            places = _gpu_places(settings["per_gpu"])
            execute, processes = partial(_execute_on_gpus, places), len(places)
    count = len(by_path) + len(ended)
    if ended:
        print(f"{len(ended)} of {count} runs refused: {ended[0].message}", flush=True)
    try:
        ended.extend(run_batches(cfgs, execute, settings["batch_size"], processes, settings["per_gpu"] or 1))
    finally:
        code = report(ended, count)
    return code


def _launcher_settings(launcher: DictConfig) -> Mapping[str, Any]:
    if "_target_" in launcher:
        # A launcher of Hydra, with one job per run.
        return {"inner": launcher, "batch_size": 1, "per_gpu": 0}
    for name, least in (("batch_size", 1), ("per_gpu", 0)):
        value = launcher[name]
        if value is not None and (type(value) is not int or value < least):
            raise ConfigError(f"hydra.launcher.{name} must be at least {least}, not {value}")
    inner = launcher.inner
    if inner is not None and not (OmegaConf.is_dict(inner) and "_target_" in inner):
        raise ConfigError("hydra.launcher.inner: choose one, such as hydra/launcher=batch_joblib")
    return launcher


# --------------------------------------------------------------------------------------------- configurations


def jobs_of(
    words: Sequence[str], parameters: Mapping[str, Any], config_dir: str | None = None
) -> list[list[str]]:
    """Return the overrides of each run of a sweep, given prepared overrides and an experiment's values by
    key, which overrides replace. Hydra's settings are ignored."""
    parsed = parse([*(f"{key}={value}" for key, value in parameters.items()), *words])
    # The last value of a key counts.
    given = {one.get_key_element(): one for one in parsed if not one.is_hydra_override()}
    values = ((one, swept(one, choices(one.key_or_group, config_dir))) for one in given.values())
    each = [[f"{one.get_key_element()}={value}" for value in own] for one, own in values]
    return [list(job) for job in itertools.product(*each)]


def sweep_configs(
    words: Sequence[str], defaults: Mapping[str, Sequence[str]], keys: Sequence[str] = ()
) -> list[Config]:
    """Return the checked configurations of a sweep.

    Args:
        words: Overrides.
        defaults: Values by key for keys without an override.
        keys: The only keys that have an effect; empty for all.

    Raises:
        plab.config.ConfigError: If an override is invalid or has no effect.
    """
    words = prepared(words)
    given = {one.key_or_group: one.input_line for one in parse(words)}
    if without := [line for key, line in given.items() if keys and key not in keys]:
        raise ConfigError(f"'{without[0]}' has no effect here; choose from: {', '.join(keys)}")
    added = [f"{key}={','.join(values)}" for key, values in defaults.items() if key not in given]
    return [load_config(job) for job in jobs_of([*words, *added], {})]


def compose_jobs(jobs: Sequence[Sequence[str]], config_dir: str | None = None) -> list[Config | Outcome]:
    """Compose and check the runs of a sweep, given prepared overrides for each; return a configuration or an
    error for each. Shared parts are checked once."""

    @cache
    def checked(words: tuple[str, ...]) -> Config | str:
        """Return a configuration, or the error in the configuration, its scene or its target."""
        try:
            cfg = finish(compose(words, config_dir), words, alone=False)
            check_sources(cfg)
        except PlabError as error:
            return str(error)
        return cfg

    entries: list[Config | Outcome] = []
    for job in jobs:
        # No other value of a configuration depends on the seed.
        seeds = [word for word in job if re.fullmatch(r"seed=\d{1,9}", word)]
        made = checked(tuple(word for word in job if word not in seeds))
        if isinstance(made, str):
            entries.append(Outcome(" ".join(job), "", "refused", message=made))
        else:
            entries.append(replace(made, seed=int(seeds[-1].partition("=")[2])) if seeds else made)
    return entries


# ---------------------------------------------------------------------------------------------------- batches


def plan(
    cfgs: Sequence[Config], size: int | None = None, processes: int = 1, sharing: int = 1
) -> list[list[Config]]:
    """Divide configurations into batches.

    Runs of one task share a batch if their methods differ only in optimiser and contact model, or are equal
    learning methods; variants, seeds and materials may differ. Runs of other methods form batches of one,
    ordered by kind.

    Args:
        cfgs: The composed and checked configurations.
        size: Largest number of runs in a batch; default: as many as fit into ``sim.memory_mb`` (trajectories
            and planners) or half of the device's memory (agents).
        processes: Number of processes; each gets a batch if there are enough runs.
        sharing: Number of processes that share the memory of a device.

    Returns:
        Batches, evenly filled within each kind.
    """
    groups: dict[str, list[Config]] = {}
    for cfg, scene in zip(cfgs, build_scenes(cfgs), strict=True):
        groups.setdefault(json.dumps(_kind(cfg, scene)), []).append(cfg)
    batches = []
    for group in groups.values():
        limit = _limit(group[0], size, sharing)
        count = min(max(-(-len(group) // limit), -(-processes // len(groups))), len(group))
        bounds = [len(group) * k // count for k in range(count + 1)]
        batches += [group[a:b] for a, b in itertools.pairwise(bounds)]
    return batches


def _kind(cfg: Config, scene: Scene) -> list[Any]:
    """Return the settings that must agree within a batch, or between successive batches of a simulator."""
    method = asdict(cfg.method)
    loss = [method["loss_weights"], method["loss_terms"]]
    shared = [asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
    seen = [getattr(cfg, key) for key in OBSERVATION_KEYS]
    kind = [cfg.task.name, cfg.method.family, seen, *shared, loss]
    own = family(cfg.method.family)
    if not own.batching:
        return [*kind, cfg.variant, asdict(cfg.task), method]
    # Runs of different lengths would leave environments idle, and agents are trained in lockstep.
    alike = method if own.in_step else row_count(method, cfg.sim.horizon)
    return [*kind, alike, *scene_kind(scene)]


def _limit(cfg: Config, size: int | None, sharing: int) -> int:
    own, scene = family(cfg.method.family), build_scene(cfg)
    if not own.batching:
        return 1
    if size is not None:
        return size
    if not own.in_step:
        return batch_limit(scene, cfg.sim.precision, cfg.sim.device, cfg.sim.memory_mb)
    # Agents need no gradient, so its budget sim.memory_mb does not apply.
    room = most_environments(scene, cfg.sim.precision, cfg.sim.device) // sharing
    return max(1, room // asdict(cfg.method)["num_envs"])


def run_batches(
    cfgs: Sequence[Config], execute: Executor, size: int | None = None, processes: int = 1, sharing: int = 1
) -> Iterator[Outcome]:
    """Execute the unfinished runs of a sweep and yield outcomes.

    Runs in progress in other processes are skipped, and resumed here if such a process ends early. Other
    arguments are those of :func:`plan`.
    """
    # Duplicates count once.
    wanted = {str(cfg.path): cfg for cfg in cfgs}
    ended: dict[str, Outcome] = {}
    for path, cfg in wanted.items():
        if not cfg.force and (done := _finished_before(cfg)) is not None:
            ended[path] = done
            yield done
    if ended:
        print(f"{len(ended)} of {len(wanted)} runs finished before", flush=True)
    todo = [cfg for path, cfg in wanted.items() if path not in ended]
    while todo:
        away = []
        for one in execute(
            plan(todo, size, processes, sharing), lambda: f"[{len(ended)}/{len(wanted)} runs] "
        ):
            if one.status == "elsewhere":
                away.append(one)
            else:
                ended[one.path] = one
                yield one
        todo = [wanted[one.path] for one in away if not held(one.path)]
        yield from (one for one in away if held(one.path))


def execute_batches(batches: list[list[Config]], progress: Callable[[], str]) -> Iterator[Outcome]:
    """Execute batches sequentially in this process."""
    cache = SimulatorCache()
    for batch in batches:
        yield from runners.run_batch(batch, progress(), cache)


def _submit_batches(
    master: DictConfig,
    inner: DictConfig,
    jobs: Mapping[str, list[str]],
    batches: list[list[Config]],
    _progress: Callable[[], str],
) -> Iterator[Outcome]:
    """Submit batches to a Hydra launcher, one job each, given the overrides of each run by file."""
    config = deepcopy(master)
    with open_dict(config.hydra):
        config.hydra.launcher = inner
    name = inner["_target_"].rpartition(".")[2]
    runs = sum(len(batch) for batch in batches)
    alone = "; hydra.launcher.batch_size=1 submits one job per run" if runs > len(batches) == 1 else ""
    print(f"{runs} runs go to {name} in {len(batches)} jobs{alone}", flush=True)
    try:
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(hydra_app().config_loader, Callbacks(config)),
            task_function=partial(_job, batches),
            config=config,
        )
        export_module_path()
        # A job composes the configuration of its first run and then computes the whole batch.
        returns = launcher.launch([jobs[str(batch[0].path)] for batch in batches], 0)
        yield from [one for job in returns for one in job.return_value]
    except Exception as error:
        # A job was killed, or the queue rejected the jobs; the result files have the progress.
        print_error(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:300]}")
        yield from [stored_outcome(cfg) for batch in batches for cfg in batch]


def _job(batches: Sequence[Sequence[Config]], _composed: DictConfig) -> list[Outcome]:
    """Execute a batch in the process of a launcher's job."""
    number = HydraConfig.get().job.num
    note = f"[batch {number + 1}/{len(batches)}] " if len(batches) > 1 else ""
    return runners.run_batch(batches[number], note, SimulatorCache())


def stored_outcome(cfg: Config) -> Outcome:
    """Return the outcome of a run whose process was killed, from its files."""
    path = cfg.path
    if (done := _finished_before(cfg)) is not None:
        return Outcome.of(cfg, "finished", done.score)
    if held(path):
        return Outcome.of(cfg, "elsewhere", message=f"{path} is being computed by another process")
    try:
        left = read(path.with_suffix(PARTIAL_SUFFIX))
    except ResultsError:
        return Outcome.of(cfg, "lost", message="no result, and no process is computing it")
    if left.status == "failed":
        return Outcome.of(cfg, "failed", message=left.message)
    return Outcome.of(cfg, "lost", message=f"{left.rows} iterations, and no process is computing it")


def _finished_before(cfg: Config) -> Outcome | None:
    path = cfg.path
    left = (lock_path(path), path.with_suffix(PARTIAL_SUFFIX))
    try:
        # RunFile removes leftovers of killed processes.
        result = RunFile(cfg).result if path.exists() and any(map(Path.exists, left)) else read(path)
    except ResultsError:
        return None
    return Outcome.of(cfg, "before", result.score) if result.status == "finished" else None


# ------------------------------------------------------------------------------------------------------- GPUs


def _gpu_places(per_gpu: int) -> list[str]:
    """Return the GPU of each worker process, ``per_gpu`` on each; raise ConfigError if there is no GPU."""
    named = os.environ.get(VISIBLE)
    found = range(cuda_devices()) if named is None else filter(None, named.split(","))
    if not (names := [str(one).strip() for one in found]):
        raise ConfigError("hydra/launcher=batch_gpus: this computer has no usable CUDA device; omit it")
    # The first processes are distributed evenly over GPUs.
    return names * per_gpu


def _execute_on_gpus(
    places: Sequence[str], batches: list[list[Config]], progress: Callable[[], str]
) -> Iterator[Outcome]:
    """Execute batches in a process per place, each in the next free one, and yield the outcomes."""
    with ExitStack() as pools:
        waiting = list(batches)
        free = [(gpu, pools.enter_context(_pool(gpu))) for gpu in places[: len(batches)]]
        running: dict[Future[list[Outcome]], tuple[str, ProcessPoolExecutor, list[Config]]] = {}
        try:
            while waiting or running:
                while waiting and free:
                    (gpu, pool), batch = free.pop(0), waiting.pop(0)
                    running[pool.submit(_carry_out, batch, f"GPU {gpu} {progress()}")] = gpu, pool, batch
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    gpu, pool, batch = running.pop(future)
                    try:
                        yield from future.result()
                    except BrokenProcessPool:
                        # After a kill, the result files have the progress.
                        pool = pools.enter_context(_pool(gpu))
                        yield from map(stored_outcome, batch)
                    free.append((gpu, pool))
        except BaseException:
            # After Ctrl-C, busy processes write a checkpoint.
            for process in multiprocessing.active_children():
                process.terminate()
            raise


# Code below runs in the worker processes.
_cache = SimulatorCache()


def _pool(gpu: str) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, (gpu,))


def _begin(gpu: str) -> None:
    os.environ[VISIBLE] = gpu
    # Ctrl-C reaches all processes of a terminal; the parent process ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _carry_out(batch: list[Config], note: str) -> list[Outcome]:
    handler: Any = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return runners.run_batch(batch, note, _cache)
    finally:
        signal.signal(signal.SIGTERM, handler)


def _end_with_parent() -> None:
    """End this process, releasing its locks, when its parent ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
