"""Progress of a run on a terminal, its last lines, and immediately stored rows."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from rich.console import Console

from plab import progress
from plab.cli.run import main
from plab.results import RunFile
from plab.results import read as read_result
from plab.sim import compiler
from plab.sim.compiler import watch_compiling
from same_runs import make_simulator
from toy_runner import COARSE

SEARCH = ("method=cem", "method.population=4", "method.elites=2", "method.iterations=3")


@pytest.fixture
def screen(monkeypatch) -> io.StringIO:
    """Fake terminal."""
    text = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda: Console(file=text, force_terminal=True, width=80))
    return text


def test_a_run_from_its_bar_to_its_last_lines(tmp_path, screen, monkeypatch, capsys) -> None:
    kept: list[tuple[int, int]] = []
    compiled: list[str] = []
    entry, record = getattr(compiler._traced, compiler._TRACE), RunFile.record

    def look(run: RunFile, *args, **kwargs) -> None:
        record(run, *args, **kwargs)
        kept.append((len(read_result(run.partial_path).iterations), len(compiled)))

    @contextmanager
    def watch(tell: Callable[[str], None]) -> Iterator[None]:
        with watch_compiling(lambda name: (compiled.append(name), tell(name))):
            yield

    monkeypatch.setattr("plab.sim.compiler.watch_compiling", watch)
    monkeypatch.setattr("plab.problem.make_simulator", make_simulator)  # a new one
    monkeypatch.setattr(RunFile, "record", look)
    monkeypatch.chdir(tmp_path)
    argv = ["task=Rope", *COARSE, *SEARCH, "checkpoint_seconds=1e6"]
    assert main(argv) == 0
    # The first iteration is kept at once, later ones follow after checkpoint_seconds; these compile nothing.
    assert kept == [(1, kept[0][1])] * 3
    assert {"step_kernel", "losses_kernel"} <= set(compiled[: kept[0][1]])
    # Each begins and ends before the next begins.
    assert all(compiled[0::2]) and not any(compiled[1::2]) and len(compiled) % 2 == 0
    assert getattr(compiler._traced, compiler._TRACE) is entry
    kernels = compiler.impl.get_runtime().kernels
    assert kernels and all("launch_kernel" not in vars(kernel) for kernel in kernels)
    seen = re.sub(r"\x1b\[[\d;?]*\w", "", screen.getvalue())
    assert "Rope-v1 cem seed 0 build" in seen and "Rope-v1 cem seed 0 final evaluation" in seen
    assert re.search(r"compiling \w+", seen)
    assert re.search(r"/3 \d:\d\d:\d\d loss [\d.]+ \w+ score \d\.\d{3} best score [\d.]+", seen)
    *_, score, hint = capsys.readouterr().out.splitlines()
    assert score.startswith("finished: score 0.0000, results/Rope-v1/cem/seed0-")
    assert f"plab render {score.rpartition(' ')[2]};" in hint and main([*argv, "progress=false"]) == 0
    assert capsys.readouterr().out == f"finished before: {score.partition(': ')[2]}\n"
