"""Materials of bodies: code of docs/own_materials.md, and materials in configurations and results."""

from __future__ import annotations

import contextlib
import io
import math
import shlex

import pytest

from pages import ROOT, blocks
from plab.config import Config, build_scene, load_config
from plab.run import main

CONF = ROOT / "examples" / "own_materials" / "conf"
PAGE = "own_materials.md"
RUBBER = {"youngs_modulus": 2000.0, "poisson_ratio": 0.3, "yield_stress": math.inf}


def arguments(line: str) -> list[str]:
    """Arguments of a ``plab run`` line of the page, with the path of the example's folder."""
    words = shlex.split(line.removeprefix("$ "))
    assert words[:2] == ["plab", "run"]
    return [str(ROOT / word) if word.startswith("examples/") else word for word in words[2:]]


def example(*overrides: str) -> Config:
    return load_config(["task=Cushion", *overrides], CONF)


def test_the_page_shows_the_example_and_its_commands_are_runs_of_it(seen, tmp_path, monkeypatch):
    assert blocks(PAGE, "yaml")[0] in (CONF / "task" / "Cushion.yaml").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for line in blocks(PAGE, "bash")[0].splitlines():
        assert main(arguments(line)) == 0
    assert [build_scene(cfg).materials[1].youngs_modulus for cfg in seen] == [2000.0, 500.0, 3000.0]


@pytest.mark.nightly
def test_the_cushions_do_as_the_page_prints(monkeypatch):
    monkeypatch.chdir(ROOT)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        names: dict = {}
        exec("\n".join(blocks(PAGE, "python")), names)
    assert printed.getvalue().startswith(blocks(PAGE, "text")[0])
    assert names["by_young"][1] > 0.0 and names["by_yield"][0] != 0.0


def test_a_body_has_the_values_of_its_task_and_its_own():
    dough, cushion = build_scene(example()).materials
    assert (dough.youngs_modulus, dough.poisson_ratio, dough.yield_stress) == (5000.0, 0.2, 50.0)
    assert cushion.values == RUBBER
    yields = build_scene(example("variant=3", "task.poisson_ratio=0.1")).materials
    assert [m.yield_stress for m in yields] == [50.0, 50.0] and yields[0].poisson_ratio == 0.1
    # Without a value of its own again.
    assert build_scene(example("task.bodies.cushion.yield_stress=null")).materials[1].yield_stress == 50.0
