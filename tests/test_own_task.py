"""A folder of the user's own: what docs/own_task.md says, and the mistakes one can make in it."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from plab.cli.run import main
from plab.config import ConfigError, build_scene, choices, load_config
from plab.results import load
from plab.targets import build_target

ROOT = Path(__file__).resolve().parents[1]
OWN = ROOT / "examples" / "own_task" / "conf"
DUMBBELL = (OWN / "task" / "Dumbbell.yaml").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "own_task.md").read_text(encoding="utf-8")
MISTAKES_PAGE = (ROOT / "docs" / "developers" / "mistakes.md").read_text(encoding="utf-8")
ANSWERED = MISTAKES_PAGE.partition("## A task of one's own")[2].partition("\n## ")[0]
COARSE = ("sim.grid_size=16", "sim.dt=4e-4", "sim.horizon=3", "method.iterations=2", "progress=false")


def blocks(language: str, text: str = PAGE) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def arguments(line: str) -> list[str]:
    """Arguments of a ``python -m plab.run`` line of the page, with the example's folder where it is."""
    words = shlex.split(line.removeprefix("$ "), comments=True)
    assert words[:3] == ["python", "-m", "plab.run"]
    return [str(ROOT / word) if word.startswith("examples/") else word for word in words[3:]]


COMMANDS = [
    line
    for block in blocks("bash")
    for line in block.splitlines()
    if line.startswith("python -m plab.run") and "--help" not in line
]


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def own(tmp_path) -> Callable[..., Path]:
    """Write a folder with one task, made from the example by replacing pieces of text."""

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


# ------------------------------------------------------------------------------ the page


@pytest.mark.parametrize("excerpt", blocks("yaml"), ids=lambda text: text.split(":")[0].strip())
def test_excerpts_are_from_the_example(excerpt):
    assert excerpt in DUMBBELL


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_are_accepted(seen, line):
    assert main(arguments(line)) == 0
    (cfg,) = seen
    assert (cfg.task.name, cfg.sim.grid_size) == ("Dumbbell", 32)


@pytest.mark.nightly
def test_commands_run():
    for line in COMMANDS:
        assert main([*arguments(line), *COARSE]) == 0
    table = load("results")
    assert sorted(table["variant"]) == ["1", "2", "random1"]
    assert set(table["status"]) == {"finished"} and set(table["iterations"]) == {2}


def test_python_as_on_the_page(monkeypatch):
    monkeypatch.chdir(ROOT)
    (code,) = blocks("python")
    names: dict = {}
    exec(code, names)
    assert names["scene"].grid_size == 32
    assert names["scene"].name == "Dumbbell"


CONSOLE = re.findall(r"^\$ (.*)\n(plab: .*)$", "\n".join(blocks("console", PAGE + ANSWERED)), re.MULTILINE)


@pytest.mark.parametrize(("command", "answer"), CONSOLE, ids=[command for command, _ in CONSOLE])
def test_answers_to_commands(capsys, command, answer):
    assert main(arguments(command)) == 2
    line = capsys.readouterr().err.removesuffix("\n")
    assert re.fullmatch(re.escape(answer).replace(r"\.\.\.", ".*"), line)


ANSWERS = dict(re.findall(r"^\| (.*) \| `(plab: .*)` \|$", ANSWERED, re.MULTILINE))
MISTAKES = {
    "`sise: [0.06]` instead of `size`": ("    size: [0.06]        # sphere", "    sise: [0.06]  # sphere"),
    "no `yield_stress`": ("yield_stress: 200.0", "#"),
    "`yield_stress: soft`": ("yield_stress: 200.0", "yield_stress: soft"),
    '`1:` instead of `"1":`': ('  "1":', "  1:"),
    "`recipe: balls`": ("recipe: bodies", "recipe: balls"),
    "a bracket left open": ("[0.0, -30.0, 0.0]", "[0.0, -30.0, 0.0"),
}


def test_the_page_lists_these_mistakes():
    assert list(ANSWERS) == list(MISTAKES)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_answers_to_mistakes_in_the_file(capsys, own, mistake):
    assert main(["--config-dir", str(own(MISTAKES[mistake])), "task=Dumbbell"]) == 2
    line = capsys.readouterr().err.removesuffix("\n")
    assert re.fullmatch(re.escape(ANSWERS[mistake]).replace(r"\.\.\.", ".*"), line)


# ------------------------------------------------------------------------------ the folder


def test_every_variant_of_the_example_is_valid_and_keeps_the_volume():
    for overrides in (
        ["variant=1"],
        ["variant=2"],
        *(["variant=random", f"seed_scene={k}"] for k in range(5)),
    ):
        cfg = load_config(["task=Dumbbell", *overrides], OWN)
        scene = build_scene(cfg)
        build_target(scene, cfg.task.target)
        start = {name: (body.shape, body.size) for name, body in cfg.task.bodies.items()}
        end = {name: (body["shape"], body["size"]) for name, body in cfg.task.target["bodies"].items()}
        assert start == end


def test_names_of_both_folders_are_offered(capsys):
    assert main(["--help", "--config-dir", str(OWN)]) == 0
    assert "Dumbbell" in capsys.readouterr().out
    assert main(["--help-all", "--config-dir", str(OWN)]) == 0
    text, _ = capsys.readouterr()
    assert "task=Dumbbell   Two spheres catch a dumbbell" in text
    assert "sim=coarse     A coarse grid" in text and "sim=fast" in text and "task=Rope" in text
    assert {*choices("task"), "Dumbbell"} == set(choices("task", OWN))


def test_a_sweep_over_tasks_of_both_folders(seen):
    assert main(["-m", "task=Dumbbell,Rope", "--config-dir", str(OWN), "sim=coarse,fast"]) == 0
    assert [(cfg.task.name, cfg.sim.grid_size) for cfg in seen] == [
        ("Dumbbell", 32),
        ("Dumbbell", 64),
        ("Rope", 32),
        ("Rope", 64),
    ]


def test_the_folder_may_be_relative_and_have_any_name(own, monkeypatch, seen, tmp_path):
    folder = own()
    strange = folder.rename(tmp_path / "it's {a} [folder], $x=1")
    cfg = load_config(["task=Dumbbell"], strange.name)
    assert main(["--config-dir", strange.name, "task=Dumbbell"]) == 0
    assert seen == [cfg]


def test_a_method_of_ones_own(own):
    folder = own()
    (folder / "method").mkdir()
    (folder / "method" / "slow.yaml").write_text("defaults: [adam, _self_]\nname: slow\nlr: 0.01\n")
    cfg = load_config(["task=Dumbbell", "method=slow"], folder)
    assert (cfg.method.name, cfg.method.lr, cfg.method.betas) == ("slow", 0.01, [0.9, 0.999])


def test_a_task_with_everything_that_chopsticks_have(tmp_path):
    task = OmegaConf.to_container(OmegaConf.create(DUMBBELL))
    sticks = {"shape": "Chopsticks", "size": [0.2, 0.02], "position": [0.5, 0.6, 0.5]}
    sticks |= {"scale": [0.02] * 3 + [0.04] * 3 + [0.02], "gap": 0.08, "minimal_gap": 0.06}
    task["manipulators"] = {"sticks": task["manipulators"]["left"] | sticks}
    (tmp_path / "task").mkdir()
    OmegaConf.save(OmegaConf.create(task), tmp_path / "task" / "Sticks.yaml")
    scene = build_scene(load_config(["task=Sticks"], tmp_path))
    assert (scene.action_dim, scene.manipulators[0].gap) == (7, 0.08)


# ------------------------------------------------------------------------------ refusals


def until(section: str, instead: str = "") -> tuple[str, str]:
    """The replacement that cuts the file off before a section, or puts something else in its place."""
    return DUMBBELL[DUMBBELL.index(f"\n{section}:") :], f"\n{instead}\n"


REFUSED = [
    ([(DUMBBELL, "")], [], "has no value: give one"),
    ([(DUMBBELL, "- a\n- b\n")], [], "task/Dumbbell.yaml: Invalid type assigned: list is not a subclass"),
    ([(DUMBBELL, "words\n")], [], "task/Dumbbell.yaml: unknown key 'task.words'; choose from: name,"),
    (
        [("\nname", "\n\tname")],
        [],
        "Dumbbell.yaml, line 4: found character '\\t' that cannot start any token",
    ),
    ([("floor_friction: 1.5", "gravity: 3")], [], "line 9: found duplicate key gravity"),
    ([("name: Dumbbell", "name: my task")], [], "task.name 'my task' must be letters, digits, - and _"),
    ([until("variants")], [], "task.variants has no value: give one"),
    (
        [until("variants", "variants: {}")],
        [],
        'add variants: {"1": {}} to the task',
    ),
    (
        [until("random")],
        ["variant=random"],
        "task Dumbbell has no section 'random' to draw from; choose from: 1, 2",
    ),
    ([('  "1":', '  "a/b":')], ["variant=a/b"], "task.variants 'a/b' must be letters, digits, - and _"),
    (
        [('  "1":  ', '  "1": 3\n  "3":')],
        [],
        "variant 1 of task Dumbbell must be a part of the task's structure",
    ),
    ([('variant: "1"', 'variant: "7"')], ["variant=random"], "variant 7 of task Dumbbell does not exist"),
    ([("  shift:", "  shfit:")], ["variant=random"], "task.random: unknown key 'shfit'; did you mean shift?"),
    ([("size: [0.03]", "size: [0.03, 0.1]")], [], "positive, finite sizes (radius), not (0.03, 0.1)"),
    ([("size: [0.03]", "size: 0.03")], [], "task.manipulators.left.size: Invalid value assigned"),
]


@pytest.mark.parametrize(("pieces", "overrides", "message"), REFUSED, ids=[m for *_, m in REFUSED])
def test_a_mistake_in_the_file_is_one_line(capsys, own, pieces, overrides, message):
    folder = own(*pieces)
    assert main(["--config-dir", str(folder), "task=Dumbbell", *overrides]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("plab: ") and err.count("\n") == 1
    assert message in err


def test_a_name_that_plab_uses(own):
    folder = own(name="Rope")
    with pytest.raises(
        ConfigError, match=r"Rope\.yaml: plab has a task of this name, give the file another one"
    ):
        load_config(["task=Move"], folder)


def test_a_missing_folder(capsys):
    with pytest.raises(ConfigError, match="config folder 'nowhere' does not exist"):
        load_config(config_dir="nowhere")
    for argv in (["task=Move"], ["--help"], ["-m", "seed=1,2"]):
        assert main(["--config-dir", "nowhere", *argv]) == 2
        assert capsys.readouterr().err == "plab: config folder 'nowhere' does not exist\n"
