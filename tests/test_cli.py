"""The command line: help, one line and exit code 2 for every mistake, sweeps, Ctrl-C, traces on disk."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl

from plab.cli.run import main
from plab.config import GROUPS, Config, choices
from plab.config.checks import cuda_is_usable
from plab.results import ResultsError
from plab.reuse import SimulatorCache
from plab.runners import RunError

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def plab(*argv: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "plab.run", *argv], cwd=cwd, capture_output=True, text=True, check=False
    )


REFUSED = [
    (["task=Ropee"], "task 'Ropee' does not exist; did you mean Rope? choose from: Assembly, Chopsticks,"),
    (
        ["method=a2c"],
        "choose from: adam, adam_h, apg, cem, cmaes, gd, hybrid, mppi, multistart, pods, ppo, sac, shac,",
    ),
    (
        ["+experiment=yield_ablatoin"],
        "experiment 'yield_ablatoin' does not exist; did you mean yield_ablation?",
    ),
    (["-m", "+experiment=yield_ablatoin"], "did you mean yield_ablation?"),
    (["sim=slow"], "choose from: fast, reference"),
    (["tsk=Move"], "unknown key 'tsk'; did you mean task?"),
    (["seed=abc"], "could not be converted to Integer"),
    (["seed=-1"], "seed must be at least 0, not -1"),
    (["variant=6"], "variant 6 of task Rope does not exist; choose from: 1, 2, 3, 4, 5"),
    (["seed=0,1"], "add -m"),
    (["Rope"], "cannot read 'Rope': write key=value"),
    (["~seed"], "keys cannot be removed"),
    (["method.lr=0"], "method.lr must be positive"),
    (["sim.dt=1e-3"], "dt 0.001 is above the stability limit 0.000171"),
    (["task.bodies.rope.center=[0.5,0.5,0.99]"], "outside the domain"),
    (["task.target.radius=0.6"], "the target reaches outside the domain"),
    (["--mutlirun"], "unknown flag --mutlirun; did you mean --multirun?"),
    (["--cfg"], "argument --cfg/-c: expected one argument"),
    (["--cfg", "job", "-m"], "Only one of --run, --multirun, --cfg"),
    (["--cfg", "job", "task=Ropee"], "did you mean Rope?"),
    (["--config-name", "other"], "other"),
    (["--config-dir", "nowhere"], "config folder 'nowhere' does not exist"),
    (["-m", "variant=1,2", "task=Ropee"], "did you mean Rope?"),
    (["variant=random", "seed_scene=-1"], "seed_scene must be an integer of at least 0, not -1"),
    (["seed_scene=1"], "has no effect without variant=random"),
    (["hydra/launcher=cluster"], "hydra/launcher 'cluster' does not exist"),
    (["hydra.run.dri=x"], "unknown key 'hydra.run.dri'"),
]


@pytest.mark.parametrize(("argv", "message"), REFUSED, ids=[" ".join(argv) for argv, _ in REFUSED])
def test_a_mistake_is_one_line_and_exit_code_2(refused, argv, message):
    assert message in refused(argv)


@pytest.mark.skipif(cuda_is_usable(), reason="there is a CUDA device")
def test_cuda_without_a_device(refused):
    assert "no usable CUDA device; choose sim.device=cpu" in refused(["sim.device=cuda"])


@pytest.mark.parametrize("flags", [(), ("-m",)])
def test_a_results_folder_that_cannot_be_written(capsys, flags):
    Path("file").touch()
    assert main(["results_dir=file/results", *flags]) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("plab: "))
    assert "cannot write" in line and "file" in line


def test_a_single_run_is_composed_once(seen, monkeypatch):
    composed = []
    load = ConfigLoaderImpl.load_configuration
    monkeypatch.setattr(
        ConfigLoaderImpl,
        "load_configuration",
        lambda *args, **kwargs: composed.append(1) or load(*args, **kwargs),
    )
    assert main(["seed=3"]) == 0
    assert [cfg.seed for cfg in seen] == [3] and len(composed) == 1


@pytest.mark.parametrize("words", [["hydra.mode=MULTIRUN"], ["-m"], ["++hydra.mode=MULTIRUN"]])
def test_ways_to_ask_for_a_sweep(seen, words):
    assert main(["seed=0,1", *words]) == 0
    assert [cfg.seed for cfg in seen] == [0, 1]


def test_a_mistake_in_a_fresh_process(tmp_path):
    done = plab("sim.precison=float64", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "plab: unknown key 'sim.precison'; did you mean precision? choose from: "
        "precision, device, memory_mb, deterministic, grid_size, dt, substeps, horizon, particles_scale\n"
    )
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------------------------------- help, --cfg


def test_help_is_two_screens_with_the_names_of_all_choices(capsys):
    assert main(["--help"]) == 0
    text, _ = capsys.readouterr()
    assert main(["-h", "task=nonsense"]) == 0
    assert capsys.readouterr().out == text
    lines = text.splitlines()
    assert len(lines) <= 48 and max(map(len, lines)) <= 100
    words = set(re.findall(r"\w+", text))
    for group in (*GROUPS, "experiment"):
        assert set(choices(group)) <= words
    for key in ("variant=1", "seed=0", "results_dir=results", "method.iterations=200", "sim.device=cpu"):
        assert f"  {key} " in text
    assert "--help-all" in text


def test_help_all_names_everything(capsys):
    assert main(["--help-all"]) == main(["--help-all", "task=nonsense"]) == 0
    text, _ = capsys.readouterr()
    for group in GROUPS:
        assert all(f"{group}={name}" in text for name in choices(group))
    assert all(f"+experiment={name}" in text for name in choices("experiment"))
    for key in ("method.num_envs=1", "method.tau", "method.profiles.paper.tau=3e-4", "method.clip_range"):
        assert key in text
    for key in ("variant=1", "seed_scene=0", "seed=0", "results_dir=results", "force=false", "progress=true"):
        assert key in text
    for key in (
        "sim.precision=float32",
        "method.lr_by_task.plab={other: 0.1, Chopst",
        "method.loss_weights.sdf=10.0",
        "task.target.radius=0.135",
    ):
        assert key in text
    assert "python -m plab.run task=Rope method=adam seed=0" in text
    assert "hydra.run" not in text and "${" not in text


def test_help_is_quick_and_imports_neither_torch_nor_taichi(tmp_path):
    code = (
        "import sys; from plab.cli.run import main; main(['--help']); "
        "print(sorted({'torch', 'taichi', 'pandas', 'scipy.ndimage'} & set(sys.modules)))"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    # It takes about half a second where nothing else runs.
    assert time.perf_counter() - start < 5
    assert done.stdout.endswith("\n[]\n")


def test_cfg_job_prints_the_configuration(capsys, tmp_path):
    assert main(["--cfg", "job", "seed=3"]) == 0
    out, err = capsys.readouterr()
    assert "seed: 3\n" in out and "precision: float32\n" in out and err == ""
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------ runs, sweeps


def test_a_run_gets_the_configuration_and_leaves_nothing_else_behind(seen, tmp_path):
    assert main(["task=Move", "variant=2", "method=gd", "seed=7", "method.lr=50"]) == 0
    (cfg,) = seen
    assert (cfg.task.name, cfg.variant, cfg.method.name, cfg.seed, cfg.method.lr) == (
        "Move",
        "2",
        "gd",
        7,
        50,
    )
    assert Path.cwd() == tmp_path
    assert list(tmp_path.iterdir()) == []


def test_flags_and_overrides_come_in_any_order(seen):
    assert main(["seed=0,1", "-m", "variant=1,2"]) == 0
    assert [(cfg.seed, cfg.variant) for cfg in seen] == [(0, "1"), (0, "2"), (1, "1"), (1, "2")]
    assert list(Path.cwd().rglob("*")) == []


@pytest.mark.parametrize("flags", [(), ("-m",)])
def test_an_experiment_is_a_sweep(seen, flags):
    assert main(["+experiment=yield_ablation", "method.episodes=7", *flags]) == 0
    assert [cfg.task.yield_stress for cfg in seen] == [10, 20, 50, 100, 200, 1000]
    assert {(cfg.task.name, cfg.variant, cfg.method.name, cfg.method.episodes) for cfg in seen} == {
        ("Move", "3", "sac", 7)
    }


def test_an_experiment_is_swept_further(seen):
    assert main(["-m", "+experiment=yield_ablation", "task.yield_stress=10,20", "seed=0,1"]) == 0
    assert [(cfg.task.yield_stress, cfg.seed) for cfg in seen] == [(10, 0), (10, 1), (20, 0), (20, 1)]


def test_a_sweep_goes_on_after_a_refused_job(seen, capsys):
    assert main(["-m", "variant=1,9,2"]) == 2
    assert [cfg.variant for cfg in seen] == ["1", "2"]
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "code"),
    [(ResultsError("the disk is full"), 2), (RunError("iteration 3: the loss is not finite"), 1)],
)
def test_a_run_that_breaks_off_is_one_line(monkeypatch, capsys, error, code):
    def fail(cfg: Config, cache: SimulatorCache) -> float:
        raise error

    monkeypatch.setattr("plab.runners.run_config", fail)
    assert main([]) == code
    assert capsys.readouterr().err == f"plab: {error}\n"


def test_ctrl_c(monkeypatch, capsys):
    def interrupt(cfg: Config, cache: SimulatorCache) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr("plab.runners.run_config", interrupt)
    assert main([]) == 130
    assert capsys.readouterr().err == "plab: stopped: run the same command again to resume\n"


@pytest.mark.parametrize("error", [RuntimeError, ValueError, KeyError, RecursionError])
def test_a_bug_is_one_line_or_its_traceback(monkeypatch, capsys, error):
    def fail(cfg: Config, cache: SimulatorCache) -> float:
        raise error("a bug")

    monkeypatch.setattr("plab.runners.run_config", fail)
    with pytest.raises(error, match="a bug"):
        main([])
    monkeypatch.delenv("PLAB_TRACEBACK")
    line = fail.__code__.co_firstlineno + 1
    assert main([]) == 70
    assert capsys.readouterr().err == (
        f"plab: a bug: {error.__name__} in test_cli.py, line {line}: {error('a bug')}; unless test_cli.py is "
        "yours, please report it to plab's maintainers, with the command and what it prints with "
        "PLAB_TRACEBACK=1\n"
    )


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError(), "this computer has too little memory for that: close something, or ask for less"),
        (MemoryError("Unable to allocate 7 GiB"), "Unable to allocate 7 GiB"),
        (PermissionError(13, "Permission denied", "a.h5"), "cannot write a.h5: Permission denied"),
    ],
    ids=repr,
)
def test_a_lack_is_no_bug(monkeypatch, capsys, error, line):
    def fail(cfg: Config, cache: SimulatorCache) -> float:
        raise error

    monkeypatch.setattr("plab.runners.run_config", fail)
    assert main([]) == 2
    assert capsys.readouterr().err == f"plab: {line}\n"


def test_the_process_is_left_as_it_was(seen, monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    argv = list(sys.argv)
    assert main(["seed=1"]) == 0
    assert main(["seed=-1"]) == 2
    assert sys.argv == argv and "HYDRA_FULL_ERROR" not in os.environ


def test_a_real_run_and_the_same_command_again(tmp_path):
    command = ("task=Rope", "method=adam", *COARSE, "method.iterations=2")
    first, again = (plab(*command, cwd=tmp_path) for _ in range(2))
    assert (first.returncode, first.stderr) == (0, "")
    assert again.returncode == 0 and "finished before" in again.stdout
    (result,) = (path for path in tmp_path.rglob("*") if path.is_file())
    assert result.parent == tmp_path / "results" / "Rope-v1" / "adam" and result.suffix == ".h5"
