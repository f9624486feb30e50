"""Submissions played: recorded from an agent, simulated again, lies found, an outsider from start to end."""

from __future__ import annotations

import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from gymnasium.wrappers import RescaleAction
from onnx import TensorProto, helper

import plab  # noqa: F401
from plab.cli import leaderboard, submit, verify
from plab.envs.vector import PlabVectorEnv
from plab.submissions import record
from plab.submissions.files import read, write
from plab.submissions.schema import Submission, SubmissionError
from plab.submissions.verifying import BROKE_OFF, HOLDS, LIES, NOT_RUN, read_verification
from plab.submissions.verifying import verify as simulate_again

ROOT = Path(__file__).resolve().parents[1]
COARSE = ("sim.grid_size=32", "sim.horizon=6", "sim.substeps=7", "sim.dt=2.7e-4", "sim.particles_scale=0.03")
CARD = ROOT / "examples" / "outside_agent" / "card.yaml"


def make(variant: str = "1", **keywords: Any) -> gymnasium.Env:
    return gymnasium.make(f"plab/RollingPin-v{variant}", overrides=list(COARSE), **keywords)


def episode(env: gymnasium.Env, actions: np.ndarray) -> float:
    """Play some actions; return the score of the last."""
    env.reset(seed=0)
    return [env.step(action.astype(np.float32))[4]["score"] for action in actions][-1]


@pytest.fixture
def plans() -> np.ndarray:
    """Three plans, which score 0.004, 0.011 and 0.001 in variant 1; shape [plan, T, A]."""
    return np.stack([np.tile(np.float32(action), (6, 1)) for action in ([0, 1, 0], [0, 0, -1], [-1, 0, 0])])


def submission(tmp_path: Path, *argv: str, code: int = 0) -> Path:
    made = tmp_path / "mine.plabsub.zip"
    assert submit.main([*argv, "--card", str(CARD), "--output", str(made)]) == code
    return made


# ----------------------------------------------------------------------------------------------- recorder


def test_the_best_episode_of_each_budget_is_kept(
    tmp_path: Path, plans: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plab.submissions.recording.BUDGETS", (7, 13))
    env = record(make(), tmp_path)
    scores = [episode(env, plan) for plan in plans]
    found = read(tmp_path / "RollingPin-v1.plabsub.zip")
    assert scores[1] > scores[0] > scores[2] > 0
    # The first within 7 steps, the second within 13 and of all.
    assert [(e.steps, e.score) for e in found.entries] == [(6, scores[0]), (12, scores[1])]
    assert np.array_equal(found.entries[1].actions, plans[1])
    assert found.card is None and found.entries[0].configuration.name == "RollingPin-v1"


def test_an_episode_that_was_left_counts_its_steps(tmp_path: Path, plans: np.ndarray) -> None:
    env = record(make(), tmp_path)
    env.reset()
    env.step(plans[0][0])
    score = episode(env, plans[1])
    (entry,) = read(tmp_path / "RollingPin-v1.plabsub.zip").entries
    assert (entry.steps, entry.score) == (7, score) and np.array_equal(entry.actions, plans[1])


def test_actions_beyond_the_bounds_are_recorded_as_the_simulator_takes_them(tmp_path: Path) -> None:
    env = record(make(disable_env_checker=True), tmp_path)
    score = episode(env, np.full((6, 3), 7.0))
    (entry,) = read(tmp_path / "RollingPin-v1.plabsub.zip").entries
    assert np.array_equal(entry.actions, np.ones((6, 3))) and entry.score == score


def test_environments_of_a_configuration_share_a_recording(tmp_path: Path, plans: np.ndarray) -> None:
    first, second = (record(make(), tmp_path) for _ in range(2))
    episode(first, plans[0])
    best = episode(second, plans[1])
    found = read(tmp_path / "RollingPin-v1.plabsub.zip").entries
    assert [(e.steps, e.score) for e in found] == [(12, best)]


def test_many_environments_in_one_simulator(tmp_path: Path, plans: np.ndarray) -> None:
    own = [["variant=1"], ["variant=1"], ["variant=2"]]
    overrides = list(COARSE)
    envs = gymnasium.make_vec("plab/RollingPin-v1", num_envs=3, overrides=overrides, overrides_per_env=own)
    envs = record(envs, tmp_path)
    envs.reset()
    for actions in plans.swapaxes(0, 1):
        infos = envs.step(actions)[4]
    scores = infos["final_info"]["score"]
    (one,), (two,) = (read(tmp_path / f"RollingPin-v{v}.plabsub.zip").entries for v in "12")
    assert (one.steps, one.score, two.steps, two.score) == (12, scores[1], 6, scores[2])
    assert np.array_equal(one.actions, plans[1]) and np.array_equal(two.actions, plans[2])


def test_what_cannot_be_recorded(tmp_path: Path) -> None:
    def why(env: Any, folder: Path = tmp_path) -> str:
        with pytest.raises(SubmissionError) as caught:
            record(env, folder)
        return str(caught.value)

    inside = "RescaleAction changes actions: record the environment inside of it"
    assert why(RescaleAction(make(), np.float32(0), np.float32(1))) == inside
    assert why(gymnasium.make("CartPole-v1")) == "CartPoleEnv is no environment of plab's"
    soft = "the contact model is soft: scores are of the hard one"
    assert why(make(contact="soft")) == soft
    many = gymnasium.vector.SyncVectorEnv([make])
    each = "record each environment inside of it, or what make_vec gives at once"
    assert why(many) == f"SyncVectorEnv: {each}"
    assert not list(tmp_path.iterdir())
    there = tmp_path / "RollingPin-v1.plabsub.zip"
    there.write_bytes(b"")
    assert why(make()) == f"{there} is there already: record into another folder, or remove it"


# ----------------------------------------------------------------------------------------------- verifying


@pytest.fixture
def recorded(tmp_path: Path, plans: np.ndarray) -> Path:
    """A submission of two configurations, recorded and packed."""
    for variant, plan in zip("12", plans, strict=False):
        episode(record(make(variant), tmp_path / "recordings"), plan)
    return submission(tmp_path, str(tmp_path / "recordings"))


def test_claims_hold_to_the_bit_and_in_float64(recorded: Path) -> None:
    found = simulate_again(read(recorded), COARSE)
    assert found.outcomes == {HOLDS}
    for verdict in found.verdicts:
        assert verdict.scores["float32"] == verdict.entry.score
        assert verdict.scores["float64"] == pytest.approx(verdict.entry.score, abs=1e-3)


def lying(path: Path, **changes: Any) -> Submission:
    """Return a submission whose second claim is another one."""
    from dataclasses import replace

    honest = read(path)
    first, second = honest.entries
    write(replace(honest, entries=(first, replace(second, **changes))), path)
    return read(path)


def test_a_lie_is_found(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    honest = read(recorded).entries[1]
    claimed = round(min(honest.score + 0.5, 1.0), 4)
    lying(recorded, score=claimed)
    assert verify.main([str(recorded), "--float32", *COARSE]) == 1
    out, err = capsys.readouterr()
    reached = f"scores {honest.score:.4f} in float32 (tolerance 0.02)"
    line = f"plab: {recorded}: RollingPin-v2 after 6 steps: claims {claimed:.4f}, {reached}"
    assert err.splitlines() == [line]
    assert "1 of 2 claim(s) hold" in out
    kept = read_verification(read(recorded))
    assert kept is not None and kept.outcomes == {HOLDS, LIES}


def test_plans_of_another_shape(recorded: Path) -> None:
    with pytest.raises(SubmissionError) as caught:
        simulate_again(lying(recorded, actions=np.zeros((6, 2))), COARSE)
    assert str(caught.value) == "RollingPin-v2: the plan has shape [6, 2], its task takes [6, 3]"


def test_a_simulation_that_breaks_off(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from plab.envs.core import EpisodeBatch

    usual = EpisodeBatch.step

    def broken(self: EpisodeBatch, actions: Any, *, strict: bool = True) -> Any:
        from dataclasses import replace

        return replace(usual(self, actions, strict=strict), failures={1: "at step 2: not finite"})

    monkeypatch.setattr(EpisodeBatch, "step", broken)
    good, bad = simulate_again(read(recorded), COARSE, precisions=["float32"]).verdicts
    assert (good.outcome, bad.outcome) == (HOLDS, BROKE_OFF)
    why = "the simulation broke off, float32: at step 2: not finite"
    assert bad.why == f"RollingPin-v2 after 6 steps: {why}"


# ------------------------------------------------------------------------------------------------ policies


class Acting(torch.nn.Module):
    """Goes down, and a little to where its weights say."""

    def __init__(self, entries: int, components: int = 3) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(entries, components)
        with torch.no_grad():
            self.layer.weight.mul_(1e-3)
            self.layer.bias.zero_()[-1] = -1.0

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x.clamp(-1.0, 1.0))


class Whim(Acting):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x.clamp(-1.0, 1.0)) + torch.rand(x.shape[0], 3)


def entries_of() -> int:
    return make().observation_space.shape[0]


def torchscript(path: Path, module: torch.nn.Module) -> Path:
    torch.jit.script(module).save(str(path))
    return path


def as_onnx(path: Path, module: Acting) -> Path:
    """Write the same policy in ONNX."""
    weights = {
        "w": module.layer.weight.detach().numpy(),
        "b": module.layer.bias.detach().numpy(),
        "low": np.float32(-1.0),
        "high": np.float32(1.0),
    }
    nodes = [
        helper.make_node("Clip", ["x", "low", "high"], ["c"]),
        helper.make_node("Gemm", ["c", "w", "b"], ["a"], transB=1),
    ]
    sizes = [("x", module.layer.in_features), ("a", module.layer.out_features)]
    given, made = (helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", size]) for n, size in sizes)
    held = [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "policy", [given], [made], held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))
    return path


def test_policies_of_both_kinds_are_run_only_if_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    module = Acting(entries_of())
    files = [torchscript(tmp_path / "a.pt", module), as_onnx(tmp_path / "a.onnx", module)]
    scores = []
    for file in files:
        made = submission(tmp_path, "--policy", f"RollingPin={file}", "--steps", "60", *COARSE)
        assert [e.configuration.variant for e in read(made).entries] == list("12345")
        assert verify.main([str(made), *COARSE, "--float32"]) == 1
        name = f"policies/RollingPin{file.suffix}"
        line = f"plab: {made}: {name} was not run; --run-policies runs it"
        assert capsys.readouterr().err.splitlines() == [line]
        kept = read_verification(read(made))
        assert kept is not None and kept.outcomes == {NOT_RUN}
        assert verify.main([str(made), *COARSE, "--run-policies", "--float32"]) == 0
        capsys.readouterr()
        scores.append([e.score for e in read(made).entries])
    assert scores[0] == pytest.approx(scores[1], abs=1e-3)
    assert max(scores[0]) > 0


def test_a_policy_acts_in_unseen_configurations(tmp_path: Path) -> None:
    file = torchscript(tmp_path / "a.pt", Acting(entries_of()))
    made = submission(tmp_path, "--policy", f"RollingPin={file}", "--steps", "60", "--unseen", *COARSE)
    assert sum(e.configuration.unseen for e in read(made).entries) == 10
    assert len({e.digests.scene for e in read(made).entries if e.configuration.unseen}) == 10


def test_policies_that_do_not_do(tmp_path: Path, told: Callable[..., str]) -> None:
    size = entries_of()
    file = tmp_path / "a.pt"
    argv = ["--policy", f"RollingPin={file}", "--steps", "60", *COARSE, "--card", str(CARD)]
    argv += ["--output", str(tmp_path / "x.plabsub.zip")]

    def line() -> str:
        return told(argv, submit.main).removeprefix(f"plab: {file}")

    torchscript(file, Acting(size, 2))
    assert line() == " gives actions of 2 components, its task takes 3"
    torchscript(file, Whim(size))
    assert line() == " is not deterministic: one observation has two answers"
    broken = Acting(size)
    torch.nn.init.constant_(broken.layer.bias, float("nan"))
    torchscript(file, broken)
    assert line().removeprefix("plab: ") == "policies/RollingPin.pt gives actions that are not finite"
    torchscript(file, Acting(size + 1))
    assert line().startswith("plab: policies/RollingPin.pt cannot be run (")
    file.write_bytes(b"no module")
    assert line().startswith("plab: policies/RollingPin.pt is no TorchScript module (")
    file = file.rename(tmp_path / "a.onnx")
    argv[1] = f"RollingPin={file}"
    assert told(argv, submit.main).startswith(
        "plab: policies/RollingPin.onnx is no ONNX model of one input ("
    )


# ---------------------------------------------------------------------------------------- from start to end


@pytest.mark.nightly
def test_an_agent_from_outside_gets_to_the_leaderboard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    script = ROOT / "examples" / "outside_agent" / "ppo.py"
    keywords = json.dumps({"overrides": list(COARSE)})
    argv = [
        str(script),
        "--env-id",
        "plab:plab/RollingPin-v1",
        "--env-kwargs",
        keywords,
        "--total-steps",
        "48",
        "--minibatches",
        "2",
    ]
    monkeypatch.setattr(sys, "argv", argv)
    runpy.run_path(str(script), run_name="__main__")
    assert re.findall(r"^steps (\d+),", capsys.readouterr().out, re.MULTILINE) == ["24", "48"]

    usual = ["--card", str(CARD), "--output"]
    assert submit.main(["recordings", *usual, "board/plan.plabsub.zip"]) == 0
    policy = ["--policy", "RollingPin=policy.pt", "--steps", "48", *COARSE]
    assert submit.main([*policy, *usual, "board/policy.plabsub.zip"]) == 0
    assert verify.main(["board", "--run-policies", "--float32", *COARSE]) == 0
    assert leaderboard.main(["board", *COARSE, "--out", "page"]) == 0
    text = Path("page/index.html").read_text(encoding="utf-8")
    assert text.count(">PPO in one file</a>") == 2
    # The legend has the mark once, each of the two lines once.
    assert text.count('<span class="mark verified">') == 3
    assert "Left out" not in text


def test_vector_environments_are_recorded_as_what_they_are() -> None:
    # record() takes what make_vec gives, which is no wrapper around it.
    made = gymnasium.make_vec("plab/RollingPin-v1", num_envs=1, overrides=list(COARSE))
    assert isinstance(made, PlabVectorEnv)
