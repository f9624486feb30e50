"""Objects that a configuration names as module:NAME: where they are found, what is said if they are not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from plab.config import ConfigError, MethodConfig, load_config
from plab.families import FAMILIES, Family, family, known_family
from plab.plugins import load_object, passed_on, search_in
from plab.results import check, read, result_path
from plab.runners import Runner, run_batch
from plab.sweep.plan import plan

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")

NEVER = """# A method whose module is {module}.
name: never
family: {module}:FAMILY
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A config folder of the user's, whose modules are forgotten afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    conf = tmp_path / "own" / "conf"
    (conf / "method").mkdir(parents=True)
    before = set(sys.modules)
    yield conf
    for name in set(sys.modules) - before:
        if name.startswith("zz_"):
            del sys.modules[name]


def test_modules_are_found_in_the_config_folder_and_above_it(folder: Path) -> None:
    (folder / "zz_inside.py").write_text("FOUND = 1\n")
    (folder.parent / "zz_above.py").write_text("FOUND = 2\n")
    with pytest.raises(ConfigError, match="there is no module zz_inside in the config folder"):
        load_object("zz_inside:FOUND", int)
    search_in(folder)
    search_in(folder)
    assert [load_object(f"zz_{where}:FOUND", int) for where in ("inside", "above")] == [1, 2]
    # Behind everything else, and once.
    assert sys.path[-2:] == [str(folder), str(folder.parent)] and sys.path.count(str(folder)) == 1


def test_other_processes_find_what_this_one_finds(folder: Path) -> None:
    (folder.parent / "zz_above.py").write_text("print('found')\n")
    search_in(folder)
    before = os.environ.get("PYTHONPATH")
    with passed_on():
        command = [sys.executable, "-c", "import zz_above, plab"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout == "found\n" and os.environ.get("PYTHONPATH") == before


@pytest.mark.parametrize(
    ("text", "code", "why"),
    [
        ("zz_a", "", "'zz_a' does not name an object: write module:NAME"),
        ("zz_a:", "", "'zz_a:' does not name an object: write module:NAME"),
        ("zz a:B", "", "'zz a:B' does not name an object: write module:NAME"),
        ("zz_a:B", "A = 1", "zz_a.py has no B"),
        ("zz_a:A", "A = 'text'", "'zz_a:A' has to be a int, and is a str"),
        ("zz_a:A", "import zz_missing", "module zz_a needs zz_missing, which is not installed"),
        ("zz_a:A", "A = (", "zz_a.py, line 1: "),
        ("zz_a:A", "\nA = 1 / 0", "zz_a.py, line 2: ZeroDivisionError: division by zero"),
        ("zz_a.b:A", "A = 1", "there is no module zz_a.b "),
    ],
)
def test_what_is_wrong_is_one_line(folder: Path, text: str, code: str, why: str) -> None:
    (folder / "zz_a.py").write_text(code)
    search_in(folder)
    with pytest.raises(ConfigError) as caught:
        load_object(text, int)
    assert why in str(caught.value) and "\n" not in str(caught.value)


def test_a_family_that_is_not_there_is_said(folder: Path) -> None:
    (folder / "method" / "never.yaml").write_text(NEVER.format(module="zz_never"))
    with pytest.raises(ConfigError, match="'zz_never:FAMILY': there is no module zz_never"):
        load_config(["method=never"], folder)
    with pytest.raises(ConfigError, match="'trajectoryy' does not exist; did you mean trajectory"):
        family("trajectoryy")
    assert known_family("zz_never:FAMILY") is None and known_family("rl") is FAMILIES["rl"]


def test_a_method_without_a_family_is_said(folder: Path) -> None:
    (folder / "method" / "never.yaml").write_text("# Nothing.\nname: never\n")
    with pytest.raises(ConfigError, match=r"method\.family has no value"):
        load_config(["method=never"], folder)


OPTIMISER = """
from dataclasses import replace

import numpy as np

from plab.families import FAMILIES, Rule
from plab.runners.trajectory import UpdateRule


class Rprop(UpdateRule):
    def update(self, actions, gradient):
        rate = self.state.get("rate", np.full_like(actions, self.method.lr))
        agreement = np.sign(gradient * self.state.get("gradient", 0 * gradient))
        rate = rate * np.choose(agreement.astype(int) + 1, [0.5, 1.0, 1.2])
        self.state = {"rate": rate, "gradient": gradient}
        return actions - rate * np.sign(gradient)


FAMILY = replace(FAMILIES["trajectory"], rules={"rprop": Rule(Rprop)})
"""

RPROP = """# Adam's numbers, another update.
defaults:
  - adam
  - _self_
name: rprop
family: zz_rprop:FAMILY
optimizer: rprop
"""


def test_an_optimiser_from_outside_is_a_rule_and_its_runs_share_simulators(folder: Path) -> None:
    (folder.parent / "zz_rprop.py").write_text(OPTIMISER)
    (folder / "method" / "rprop.yaml").write_text(RPROP)
    words = ["method=rprop", *COARSE, "method.iterations=3", "progress=false", f"results_dir={folder}"]
    cfgs = [load_config([*words, f"seed={seed}"], folder) for seed in (0, 1)]
    with pytest.raises(ConfigError, match=r"method\.optimizer 'adam' does not exist; choose from: rprop"):
        load_config([*words, "method.optimizer=adam"], folder)
    assert plan(cfgs) == [cfgs]
    assert [one.status for one in run_batch(cfgs)] == ["finished"] * 2
    results = [read(result_path(cfg)) for cfg in cfgs]
    assert [result.provenance["batch"] for result in results] == [2, 2]
    assert all(np.ptp(result.iterations["loss"]) > 0 for result in results)
    assert [found for _, found in check(folder)] == [None, None]


def test_a_runner_that_is_none_is_said(folder: Path) -> None:
    wrong = "from plab.families import *\nFAMILY = Family('', 'plab.config:ApgConfig', dict)\n"
    (folder / "zz_wrong.py").write_text(wrong)
    cfg = load_config(["method=apg", f"results_dir={folder}"])
    cfg.method.family = "zz_wrong:FAMILY"
    search_in(folder)
    (ended,) = run_batch([cfg])
    assert ended.status == "refused"
    assert ended.message == "the runner of method.family 'zz_wrong:FAMILY' is no plab.runners.Runner"


@pytest.mark.parametrize("hook", ["build", "step", "iterate"])
def test_a_runner_that_lacks_hooks_is_refused(hook: str, folder: Path) -> None:
    (folder / f"zz_lacks_{hook}.py").write_text(
        "from plab.families import *\nfrom plab.runners import Runner\n"
        f"class Lacking(Runner):\n    def {hook}(self, *given): ...\n"
        "FAMILY = Family('', 'plab.config:ApgConfig', Lacking)\n"
    )
    cfg = load_config(["method=apg", f"results_dir={folder}"])
    cfg.method.family = f"zz_lacks_{hook}:FAMILY"
    search_in(folder)
    (ended,) = run_batch([cfg])
    assert ended.status == "refused"
    assert ended.message.endswith("is not finished: it needs build, and step or iterate")


def test_family_and_keys_have_to_fit() -> None:
    with pytest.raises(ConfigError, match=r"method has the keys of TrajectoryConfig: .* those of ApgConfig"):
        load_config(["method=adam", "method.family=apg"])
    with pytest.raises(ConfigError, match=r"method has the keys of SacConfig: .* those of PpoConfig"):
        load_config(["method=sac", "method.algorithm=ppo"])


def test_everything_that_a_record_names_is_there() -> None:
    for record in FAMILIES.values():
        assert isinstance(record, Family) and issubclass(record.runner_type(), Runner)
        assert set(record.may_be_nan) <= set(record.columns)
        for rule in record.rules:
            assert callable(record.rule(rule, object)) or record.rule(rule, object)
        assert all(issubclass(record.config_type(rule), MethodConfig) for rule in (None, *record.rules))
