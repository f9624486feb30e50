"""A user's config folder: commands of docs/own_task.md, names, and errors in its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pages import ROOT, blocks
from plab.cli.run import main
from plab.config import ConfigError, build_scene, load_config
from plab.targets import build_target

OWN = ROOT / "examples" / "own_task" / "conf"
DUMBBELL = (OWN / "task" / "Dumbbell.yaml").read_text(encoding="utf-8")

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


@pytest.fixture
def own(tmp_path) -> Callable[..., Path]:
    """Write a folder with one task, derived from the example by replacing strings."""

    def write(*pieces: tuple[str, str], name: str = "Dumbbell") -> Path:
        text = DUMBBELL
        for old, new in pieces:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "own conf" / "task" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path.parents[1]

    return write


def test_page_has_the_examples_lines_and_code(monkeypatch):
    assert all(excerpt in DUMBBELL for excerpt in blocks("own_task.md", "yaml"))
    monkeypatch.chdir(ROOT)
    names: dict = {}
    for code in blocks("own_task.md", "python"):
        exec(code, names)
    assert (names["scene"].grid_size, names["scene"].name) == (32, "Dumbbell")
    assert names["simulator"].state().x[0, :, 0].mean() == pytest.approx(0.607, abs=1e-3)


def test_every_variant_of_the_example_is_valid_and_keeps_the_volume():
    drawn = (["variant=random", f"seed_scene={k}"] for k in range(3))
    for overrides in (["variant=1"], ["variant=2"], *drawn):
        cfg = load_config(["task=Dumbbell", *overrides], OWN)
        build_target(build_scene(cfg), cfg.task.target)
        start = {name: (body.shape, body.size) for name, body in cfg.task.bodies.items()}
        end = {name: (body["shape"], body["size"]) for name, body in cfg.task.target["bodies"].items()}
        assert start == end


def test_a_sweep_over_tasks_of_both_folders(seen):
    assert main(["-m", "task=Dumbbell,Rope", "--config-dir", str(OWN), "sim=coarse,fast"]) == 0
    swept = [(cfg.task.name, cfg.sim.grid_size) for cfg in seen]
    assert swept == [("Dumbbell", 32), ("Dumbbell", 64), ("Rope", 32), ("Rope", 64)]


def test_a_relative_folder_with_a_method(own, seen):
    folder = own()
    (folder / "method").mkdir()
    (folder / "method" / "slow.yaml").write_text("defaults: [adam, _self_]\nname: slow\nlr: 0.01\n")
    cfg = load_config(["task=Dumbbell", "method=slow"], folder.name)
    assert (cfg.method.name, cfg.method.lr, cfg.method.betas) == ("slow", 0.01, [0.9, 0.999])
    assert main(["--config-dir", folder.name, "task=Dumbbell", "method=slow"]) == 0
    assert seen == [cfg]


@pytest.mark.parametrize(
    ("piece", "overrides", "named"),
    [
        (None, ["variant=2", "task.yield_stress=100"], "task.variants.2.yield_stress"),
        (None, ["task.youngs_modulus=50000"], "dt 0.0001"),
        (("\nname", "\n\tname"), [], "Dumbbell.yaml, line 4"),
        (("floor_friction: 1.5", ""), [], "task.floor_friction is missing"),
        (("name: Dumbbell", "name: my task"), [], "task.name"),
        (("yield_stress: 200.0", "yield_stress: ${nowhere}"), [], "nowhere"),
        (("yield_stress: 200.0", "yield_stress: soft"), [], "task.yield_stress"),
        (('  "1":', "  1:"), [], "task.variants.1"),
        (('  "1":  ', '  "1": 3\n  "3":'), [], "variant 1 of task Dumbbell"),
        (("  shift:", "  shfit:"), ["variant=random"], "'shfit'"),
        (("    size: [0.06]        # sphere", "    sise: [0.06]  # sphere"), [], "task.bodies.left.sise"),
        (("recipe: bodies", "recipe: balls"), [], "task.target.recipe"),
        (("size: [0.03]", "size: 0.03"), [], "task.manipulators.left.size: must be a list"),
    ],
)
def test_a_mistake_in_the_file_is_one_line(refused, own, piece, overrides, named):
    folder = own(piece) if piece else own()
    assert named in refused(["--config-dir", str(folder), "task=Dumbbell", *overrides])


def test_folders_that_are_missing_or_have_a_name_that_plab_uses(own, refused):
    for argv in (["task=Move"], ["--help"], ["-m", "seed=1,2"]):
        assert "'nowhere'" in refused(["--config-dir", "nowhere", *argv])
    assert "'Dumbbell'" in refused(["task=Dumbbell"])
    with pytest.raises(ConfigError, match=r"Rope\.yaml"):
        load_config(["task=Move"], own(name="Rope"))
