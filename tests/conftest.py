"""Fixtures shared by all tests; tests marked ``gpu`` are skipped without a CUDA device."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import pytest

from browsing import browser  # noqa: F401
from pages import star_files  # noqa: F401
from plab.config import Config
from plab.runners.runner import Outcome, SimulatorCache
from plab.sim.runtime import cuda_devices
from refusals import ending, refusal, snapshot
from same_runs import shared_simulator
from suite import DEVICE

# Let bugs through with their tracebacks, in the processes that tests start, too.
os.environ["PLAB_TRACEBACK"] = "1"


OF_ANY_DEVICE = ("tests/test_simulator.py", "tests/test_mixed_", "tests/verification/")
"""Tests of the simulator that need a GPU when ``PLAB_TEST_DEVICE`` is cuda."""

MOVE = """rl envs wrappers actors planners tutorials cameras datasets demonstrations mpc draws population
bench submissions_played targets render view suite""".split()
ROPE = "autograd trajectory sweep_simulated".split()
"""Files whose simulators are of the same kinds: most of the task Move, and Rope in float64."""
FIRST = """manipulators protocol kernel_pairs simulator losses kinematics laws mixed_laws mixed_materials
free_bodies runtime""".split()
"""Files that start after those: in float64 or with more threads, which invalidates all other simulators."""


@pytest.fixture(scope="session")
def device() -> str:
    """Device of the simulator's tests: ``PLAB_TEST_DEVICE``, by default cpu."""
    return DEVICE


@pytest.fixture(scope="session", autouse=True)
def _shared_simulators() -> Iterator[None]:
    """Let environments and runs of the same kind share simulators, and keep the garbage collection that finds
    free ones quick by exempting all that has been imported."""
    gc.collect()
    gc.freeze()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("problem", "envs.core", "render.rollouts", "bench.workload"):
            patch.setattr(f"plab.{name}.make_simulator", shared_simulator)
        yield
    gc.unfreeze()


@pytest.fixture(scope="module", autouse=True)
def _simulators_of_one_module(request: pytest.FixtureRequest) -> Iterator[None]:
    """Clear a module's ``CACHE`` of simulators after its last test."""
    yield
    if cache := getattr(request.module, "CACHE", None):
        cache.clear()


@pytest.fixture(autouse=True)
def _own_index(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the index of test results out of the user's cache folder."""
    folder = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setattr("plab.results.run_table.cache_dir", lambda: folder)


@pytest.fixture(autouse=True)
def _own_logging() -> Iterator[None]:
    """Undo Hydra's configuration of process-wide logging."""
    root = logging.getLogger()
    level, disabled = root.level, logging.root.manager.disable
    yield
    root.setLevel(level)
    logging.disable(disabled)
    for logger in logging.root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger):
            logger.disabled = False


@pytest.fixture
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[Config]:
    """Collect the configurations passed to the runners, instead of running them."""
    configs: list[Config] = []

    def collect(cfg: Config, cache: SimulatorCache | None = None) -> float:
        configs.append(cfg)
        return 0.5

    def collect_batch(cfgs: list[Config], note: str, cache: SimulatorCache) -> list[Outcome]:
        return [Outcome.of(cfg, "finished", collect(cfg)) for cfg in cfgs]

    monkeypatch.setattr("plab.runners.run_config", collect)
    monkeypatch.setattr("plab.runners.run_batch", collect_batch)
    return configs


@pytest.fixture
def replayed(monkeypatch: pytest.MonkeyPatch, recording: object) -> list[tuple]:
    """Use the module's recording instead of simulations; return what was to be simulated."""
    asked: list[tuple] = []
    monkeypatch.setattr("plab.render.rollouts.record", lambda *given, **_: asked.append(given) or recording)
    return asked


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., str]:
    """Call a command line that must be refused, assert an unchanged folder, and return the message."""
    from plab.cli.run import main

    def call(
        argv: Sequence[str],
        entry: Callable[[Sequence[str]], int | None] = main,
        within: AbstractContextManager[None] | None = None,
    ) -> str:
        before = snapshot(tmp_path)
        capsys.readouterr()
        with within or nullcontext():
            code = ending(entry, argv)
        line = refusal(code, *capsys.readouterr(), argv)
        assert snapshot(tmp_path) == before
        return line

    return call


@pytest.fixture
def refused(seen: list[Config], told: Callable[..., str]) -> Callable[..., str]:
    """Like ``told``, and assert that no configuration reaches the runners."""

    def call(*args: object, **kwargs: object) -> str:
        line = told(*args, **kwargs)
        assert seen == []
        return line

    return call


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if DEVICE == "cuda" and item.nodeid.startswith(OF_ANY_DEVICE):
            item.add_marker("gpu")
    order = {f"test_{name}": number for number, name in enumerate([*MOVE, *ROPE, *FIRST])}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))
    needing = [item for item in items if "gpu" in item.keywords]
    if needing and not cuda_devices():
        for item in needing:
            item.add_marker(pytest.mark.skip(reason="no usable CUDA device"))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep files in one process, and those of the same task."""
    from xdist.scheduler import LoadFileScheduling

    made = LoadFileScheduling(config, log)
    group = {name: group[0] for group in (MOVE, ROPE) for name in group}
    made._split_scope = lambda node: group.get(file := node.split("::")[0][len("tests/test_") : -3], file)
    return made
