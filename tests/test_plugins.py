"""Objects named as module:NAME in a configuration: search path, errors, an external method."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from plab.config import ConfigError
from plab.plugins import export_module_path, load_object, search_in
from refusals import why


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's config folder, whose modules are forgotten afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    conf = tmp_path / "own" / "conf"
    (conf / "method").mkdir(parents=True)
    before = set(sys.modules)
    yield conf
    for name in set(sys.modules) - before:
        if name.startswith("zz_"):
            del sys.modules[name]


def test_modules_are_found_in_the_config_folder_and_above_it(folder: Path, monkeypatch) -> None:
    (folder / "zz_inside.py").write_text("FOUND = 1\n")
    (folder.parent / "zz_above.py").write_text("FOUND = 2\n")
    (folder.parent.parent / "zz_here.py").write_text("FOUND = 3\n")
    monkeypatch.chdir(folder.parent.parent)
    with pytest.raises(ConfigError, match="zz_inside"):
        load_object("zz_inside:FOUND", int)
    search_in(folder)
    search_in(folder)
    assert [load_object(f"zz_{where}:FOUND", int) for where in ("inside", "above", "here")] == [1, 2, 3]
    # Behind everything else, and once.
    assert sys.path[-2:] == [str(folder), str(folder.parent)] and sys.path.count(str(folder)) == 1
    # Environments are registered before the user's modules are imported.
    (folder / "zz_made.py").write_text("import gymnasium\nraise OSError(gymnasium.spec('plab/Rope-v2').id)")
    command = [sys.executable, "-m", "plab", "run", "--config-dir", str(folder), "method.family=zz_made:A"]
    assert "line 2: plab/Rope-v2" in subprocess.run(command, capture_output=True, text=True).stderr
    monkeypatch.setenv("PYTHONPATH", "zz_before")
    export_module_path()
    assert os.environ["PYTHONPATH"].endswith(f"{os.pathsep}zz_before")
    command = [sys.executable, "-c", "import zz_above, plab; print(zz_above.FOUND)"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "2\n"


def test_what_is_wrong_is_one_line(folder: Path) -> None:
    search_in(folder)
    for k, (text, code, named) in enumerate(
        (
            ("zz_{}", "", "'zz_{}'"),
            ("zz {}:B", "", "'zz {}:B'"),
            ("zz_{}:B", "A = 1", "zz_{}.py has no B"),
            ("zz_{}:A", "A = 'text'", "'zz_{}:A'"),
            ("zz_{}:A", "import zz_missing", "zz_missing"),
            ("zz_{}:A", "A = (", "zz_{}.py, line 1: "),
            ("zz_{}:A", "\nA = 1 / 0", "zz_{}.py, line 2: division by zero"),
            ("zz_{}.b:A", "A = 1", "zz_{}.b"),
        )
    ):
        (folder / f"zz_{k}.py").write_text(code)
        assert named.format(k) in why(ConfigError, load_object, text.format(k), int)
