"""Command line of runs: help, sweeps, experiments, exit codes, Ctrl-C, written files."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from plab.cli import run as run_module
from plab.cli.run import main
from plab.config import GROUPS, choices
from plab.results import ResultsError
from plab.runners import RunError
from plab.sim.runtime import cuda_devices
from toy_runner import COARSE

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


@pytest.mark.skipif(cuda_devices(), reason="there is a CUDA device")
def test_cuda_without_a_device(refused):
    assert "sim.device" in refused(["sim.device=cuda"])


def test_help_names_all_choices(capsys):
    assert main(["--help"]) == 0
    text, _ = capsys.readouterr()
    assert all(set(choices(group)) <= set(re.findall(r"\w+", text)) for group in (*GROUPS, "experiment"))
    for key in ("variant=1", "seed=0", "results_dir=results", "method.iterations=200", "sim.device=cpu"):
        assert f"  {key} " in text


def test_help_all_names_everything(capsys):
    assert main(["--help-all"]) == main(["--help-all", "task=nonsense"]) == 0
    text, _ = capsys.readouterr()
    for group in GROUPS:
        assert all(f"{group}={name}" in text for name in choices(group))
    assert all(f"+experiment={name}" in text for name in choices("experiment"))
    assert "  num_envs: 1 " in text and "observe_particles: 200" in text
    assert "plab run task=Rope method=adam seed=0" in text


def test_cfg_job_prints_the_configuration(capsys, tmp_path):
    assert main(["--cfg", "job", "seed=3", "--package", "seed"]) == 0 and capsys.readouterr().out == "3\n"
    assert main(["--cfg", "job", "seed=3"]) == 0
    out, err = capsys.readouterr()
    assert "seed: 3\n" in out and "precision: float32\n" in out and err == "" and not [*tmp_path.iterdir()]


def test_a_run_gets_the_configuration_and_leaves_nothing_else_behind(seen, tmp_path):
    assert main(["task=Move", "variant=2", "method=gd", "seed=7", "method.lr=50"]) == 0
    (cfg,) = seen
    given = (cfg.task.name, cfg.variant, cfg.method.name, cfg.seed, cfg.method.lr)
    assert given == ("Move", "2", "gd", 7, 50)
    assert Path.cwd() == tmp_path and list(tmp_path.iterdir()) == []


def test_sweeps_over_groups_with_keys_that_the_default_has_not(seen):
    assert main(["-m", "task=Move", "method=sac,ppo", "method.episodes=2"]) == 0
    assert main(["-m", "method=cem,cmaes", "method.population=4"]) == 0
    assert main(["-m", "method=sac,td3", "method.tau=0.01"]) == 0
    assert [cfg.method.name for cfg in seen] == ["sac", "ppo", "cem", "cmaes", "sac", "td3"]
    assert [cfg.method.episodes for cfg in seen[:2]] == [2, 2] and seen[4].method.tau == 0.01


@pytest.mark.parametrize("mode", ["MULTIRUN", "null"])
def test_an_experiment_is_a_sweep(seen, mode):
    assert main(["+experiment=yield_ablation", "method.episodes=7", f"hydra.mode={mode}"]) == 0
    assert [cfg.task.yield_stress for cfg in seen] == [10, 20, 50, 100, 200, 1000]
    runs = {(cfg.task.name, cfg.variant, cfg.method.name, cfg.method.episodes) for cfg in seen}
    assert runs == {("Move", "3", "sac", 7)}


@pytest.mark.parametrize(
    ("error", "code", "named"),
    [
        (ResultsError("the disk is full"), 2, "the disk is full"),
        (RunError("iteration 3: the loss is not finite"), 1, "iteration 3"),
        (MemoryError(), 2, "memory"),
        (MemoryError("Unable to allocate 7 GiB"), 2, "7 GiB"),
        (PermissionError(13, "Permission denied", "a.h5"), 2, "a.h5"),
        (KeyboardInterrupt(), 130, "stopped"),
        (KeyError("a bug"), 70, "KeyError"),
        (RecursionError("a bug"), 70, "RecursionError"),
        (OverflowError('File "/own.py", line 7, in f:\n^\nno m'), 2, "Error in /own.py, line 7: no m; PLAB"),
    ],
    ids=repr,
)
def test_a_run_that_breaks_off_is_one_line(monkeypatch, capsys, error, code, named):
    monkeypatch.setattr("plab.runners.run_config", Mock(side_effect=error))
    if isinstance(error, KeyError | RecursionError | OverflowError):
        # PLAB_TRACEBACK is set in tests.
        with pytest.raises(type(error)):
            main([])
        monkeypatch.delenv("PLAB_TRACEBACK")
    if code == 70:
        named = f"a bug: {named} in {run_module.__file__}, line"
    assert main([]) == code
    line = capsys.readouterr().err
    assert line.startswith("plab: ") and line.count("\n") == 1 and named in line


def test_sigterm_ends_a_run_as_ctrl_c_does(monkeypatch, capsys):
    monkeypatch.setattr("plab.runners.run_config", lambda cfg: signal.raise_signal(signal.SIGTERM))
    assert main([]) == 130 and "run the same command again" in capsys.readouterr().err


def test_ctrl_c_while_a_command_starts(tmp_path):
    kill = "os.kill(os.getpid(), signal.SIGINT)"
    code = "from plab.cli.command import *\nwith prompt_interrupts():\n try: {}\n except BaseException: pass"
    done = subprocess.run([sys.executable, "-c", code.format(kill)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "plab: stopped\n")
    (tmp_path / "difflib.py").write_text(f"import os, signal, time; {kill}; time.sleep(9)")
    done = subprocess.run([sys.executable, "-m", "plab"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


def test_a_real_run_and_the_same_command_again(tmp_path, capsys):
    few = "method.population=4", "method.elites=2", "method.iterations=2"
    command = ("task=Rope", "method=cem", *few, *COARSE)
    words = [sys.executable, "-m", "plab.run", *command]
    # Without HOME, too, of which Taichi makes its own cache.
    homeless = {name: value for name, value in os.environ.items() if name != "HOME"}
    first = subprocess.run(words, capture_output=True, text=True, check=False, env=homeless)
    assert (first.returncode, first.stderr) == (0, "")
    assert main(command) == 0 and "finished before" in capsys.readouterr().out
    reader, closed = os.pipe()
    os.close(reader)
    assert subprocess.run(words, stdout=closed, env=homeless).returncode == 0
    (result,) = (path for path in tmp_path.rglob("*") if path.is_file())
    assert result.parent == tmp_path / "results" / "Rope-v1" / "cem" and result.suffix == ".h5"
