"""Submissions recorded from an agent, simulated again and verified; policies in both formats."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Iterator
from dataclasses import replace
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
import refusals
from plab.cli.submissions import submit, verify
from plab.config import load_config
from plab.envs.core import EpisodeBatch
from plab.submissions import record
from plab.submissions.submission import UNSEEN, SubmissionError, read, write
from plab.submissions.verifying import BROKE_OFF, HOLDS, LIES, load_policy, play, read_verification
from toy_runner import COARSE_32

ROOT = Path(__file__).resolve().parents[1]
COARSE = (*COARSE_32, "sim.horizon=6")
CARD = ROOT / "examples" / "outside_agent" / "card.yaml"
why = functools.partial(refusals.why, SubmissionError)
NAME = "RollingPin-v1.plabsub.zip"

# Three plans, which score 0.004, 0.011 and 0.001 in variant 1; shape [plan, T, A].
PLANS = np.stack([np.tile(np.float32(action), (6, 1)) for action in ([0, 1, 0], [0, 0, -1], [-1, 0, 0])])


def make(variant: str = "1", **keywords: Any) -> gymnasium.Env:
    return gymnasium.make(f"plab/RollingPin-v{variant}", overrides=list(COARSE), **keywords)


def episode(env: gymnasium.Env, actions: np.ndarray) -> float:
    """Simulate some actions; return the final score."""
    env.reset(seed=0)
    return [env.step(action.astype(np.float32))[4]["score"] for action in actions][-1]


@pytest.fixture(scope="module")
def env() -> Iterator[gymnasium.Env]:
    """Environment of variant 1, recorded into several folders."""
    made = make(disable_env_checker=True)
    yield made
    made.close()


def submission(tmp_path: Path, *argv: str) -> Path:
    made = tmp_path / "mine.plabsub.zip"
    assert submit([*argv, "--card", str(CARD), "--output", str(made)]) == 0
    return made


def test_the_best_episode_of_each_budget_is_kept(
    tmp_path: Path, env: gymnasium.Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plab.submissions.verifying.BUDGETS", (6, 13))
    # Whatever the environment is wrapped in, the actions that it takes are recorded.
    rescaled = RescaleAction(record(env, tmp_path), np.float32(-2), np.float32(2))
    pairs = zip((env, rescaled, env), PLANS * [[[1]], [[2]], [[1]]], strict=True)
    scores = [episode(one, plan) for one, plan in pairs]
    found = read(tmp_path / NAME)
    assert scores[1] > scores[0] > scores[2] > 0
    # The first within 6 steps, the second within 13 and of all.
    assert [(e.steps, e.score) for e in found.entries] == [(6, scores[0]), (12, scores[1])]
    assert np.array_equal(found.entries[1].actions, PLANS[1])
    assert found.card is None and found.entries[0].configuration.name == "RollingPin-v1"


def test_steps_of_episodes_that_were_left_count_and_actions_are_clipped(
    tmp_path: Path, env: gymnasium.Env
) -> None:
    env = record(env, tmp_path)
    env.reset()
    env.step(PLANS[0][0])
    score = episode(env, np.full((6, 3), 7.0))
    (entry,) = read(tmp_path / NAME).entries
    assert (entry.steps, entry.score) == (7, score) and np.array_equal(entry.actions, np.ones((6, 3)))


def test_many_environments_in_one_simulator(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    own = [["variant=1"], ["variant=1"], ["variant=2"], ["variant=1"], ["variant=2"]]
    overrides = list(COARSE)
    envs = gymnasium.make_vec("plab/RollingPin-v1", num_envs=5, overrides=overrides, overrides_per_env=own)
    envs = record(envs, tmp_path)
    # Only the steps of randomised episodes count.
    for options in ({"yield_stress": 30.0}, None):
        envs.reset(options=options)
        for actions in PLANS[[0, 1, 2, 0, 2]].swapaxes(0, 1):
            infos = envs.step(actions)[4]
    assert capsys.readouterr().err.count("randomised episodes") == 1
    scores = infos["score"]
    (one,), (two,) = (read(tmp_path / f"RollingPin-v{v}.plabsub.zip").entries for v in "12")
    assert (one.steps, one.score, two.steps, two.score) == (36, scores[1], 24, scores[2])
    assert np.array_equal(one.actions, PLANS[1]) and np.array_equal(two.actions, PLANS[2])


def test_what_cannot_be_recorded(tmp_path: Path, env: gymnasium.Env, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "CartPoleEnv" in why(record, gymnasium.make("CartPole-v1"), tmp_path)
    many = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")])
    assert "SyncVectorEnv" in why(record, many, tmp_path)
    for key, value, named in (("contact", "soft", "soft"), ("terminates", True, "terminate_on_success")):
        with monkeypatch.context() as patch:
            patch.setattr(env.unwrapped.batch, key, value)
            assert named in why(record, env, tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / NAME).write_bytes(b"")
    assert str(tmp_path / NAME) in why(record, env, tmp_path)


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory, env: gymnasium.Env) -> Path:
    """A submission with two configurations, recorded and packed."""
    folder = tmp_path_factory.mktemp("packed")
    for one, plan in zip((env, make("2")), PLANS, strict=False):
        episode(record(one, folder / "recordings"), plan)
    return submission(folder, str(folder / "recordings"))


@pytest.fixture
def recorded(packed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(packed, tmp_path))


def test_claims_are_simulated_again(
    recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = read(recorded)
    first, second = honest.entries
    monkeypatch.setattr("plab.submissions.verifying.TOLERANCE", 1e-9)
    near = replace(second, steps=7, score=second.score + 0.9e-9)
    lie = replace(second, steps=8, score=second.score + 1.2e-9)
    write(replace(honest, entries=(first, second, near, lie, replace(first, steps=9))), recorded)
    usual = EpisodeBatch.step

    def broken(self: EpisodeBatch, actions: Any, *, strict: bool = True) -> Any:
        return replace(usual(self, actions, strict=strict), failures={4: "at step 2: not finite"})

    monkeypatch.setattr(EpisodeBatch, "step", broken)
    assert verify([str(recorded), *COARSE]) == 1
    out, err = capsys.readouterr()
    false, broke = err.splitlines()
    told = str(recorded), "v2 after 8", f"{lie.score:.4f}", f"{second.score:.4f}"
    assert all(part in false for part in told) and "v1 after 9" in broke and "at step 2: not finite" in broke
    assert "3 of 5 claim(s) hold" in out
    kept = read_verification(read(recorded))
    assert [v.outcome for v in kept] == [HOLDS, HOLDS, HOLDS, LIES, BROKE_OFF]
    # On the CPU the same to the bit.
    assert [v.score for v in kept[:4]] == [one.score for one in (first, second, second, second)]


class Acting(torch.nn.Module):
    """Policy that moves down, and slightly towards its weights."""

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


def torchscript(path: Path, module: torch.nn.Module) -> bytes:
    torch.jit.script(module).save(str(path))
    return path.read_bytes()


def as_onnx(module: Acting) -> bytes:
    """The same policy in ONNX."""
    weights = {"low": np.float32(-1.0), "high": np.float32(1.0)}
    weights |= {"w": module.layer.weight.detach().numpy(), "b": module.layer.bias.detach().numpy()}
    nodes = [
        helper.make_node("Clip", ["x", "low", "high"], ["c"]),
        helper.make_node("Gemm", ["c", "w", "b"], ["a"], transB=1),
    ]
    sizes = [("x", module.layer.in_features), ("a", module.layer.out_features)]
    given, made = (helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", size]) for n, size in sizes)
    held = [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "policy", [given], [made], held)
    opset = [helper.make_opsetid("", 17)]
    return helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString()


def test_policies_answer_alike_in_both_formats(tmp_path: Path) -> None:
    torch.manual_seed(0)
    module = Acting(5)
    with torch.no_grad():
        module.layer.weight.mul_(1e4)
    observations = np.random.default_rng(0).normal(size=(4, 5)).astype(np.float32)
    expected = module(torch.from_numpy(observations)).detach().numpy().clip(-1.0, 1.0)
    files = {"a.pt": torchscript(tmp_path / "a.pt", module), "a.onnx": as_onnx(module)}
    for name, content in files.items():
        assert load_policy(name, content)(observations) == pytest.approx(expected, abs=1e-6)
        assert name in why(load_policy, name, b"no module")
        assert f"{name} cannot be run" in why(load_policy(name, content), observations[:, 1:])
    torch.nn.init.constant_(module.layer.bias, float("nan"))
    assert "finite" in why(load_policy("a.onnx", as_onnx(module)), observations)


def test_a_policy_is_run_only_if_asked(
    tmp_path: Path, env: gymnasium.Env, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of five variants and ten unseen ones.
    monkeypatch.setattr("plab.cli.submissions.SUITE_VARIANTS", ("1", "2", "3"))
    monkeypatch.setattr("plab.cli.submissions.UNSEEN", UNSEEN[:2])
    file = tmp_path / "a.pt"
    (size,) = env.observation_space.shape
    good = torchscript(file, Acting(size))
    made = submission(tmp_path, "--policy", f"RollingPin={file}", "--steps", "60", "--unseen", *COARSE)
    packed = read(made)
    (name,), entries = packed.policies, packed.entries
    assert [e.configuration.variant for e in entries] == ["1", "2", "3", *UNSEEN[:2]]
    assert len({e.checksum for e in entries}) == 5 and {e.steps for e in entries} == {60}
    assert max(e.score for e in entries) > 0
    for content, more, code, outcomes, told in (
        (good, [], 1, set(), ["--run-policies"]),
        (good, ["--run-policies"], 0, {HOLDS}, []),
        # An earlier outcome remains.
        (good, [], 1, {HOLDS}, ["--run-policies"]),
        (torchscript(file, Whim(size)), ["--run-policies"], 1, {BROKE_OFF}, ["not deterministic"]),
        (b"no module", ["--run-policies"], 1, {BROKE_OFF}, ["cannot be loaded"]),
    ):
        write(replace(packed, policies={name: content}), made)
        assert verify([str(made), *COARSE, *more]) == code
        lines = capsys.readouterr().err.splitlines()
        assert all(str(made) in line and part in line for line, part in zip(lines, told, strict=True))
        assert {one.outcome for one in read_verification(read(made))} == outcomes


def test_policies_whose_actions_do_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cfgs = [load_config(["task=RollingPin", *COARSE])]
    batch = EpisodeBatch(cfgs)
    monkeypatch.setattr("plab.submissions.verifying.EpisodeBatch", lambda cfgs: batch)
    (size,) = batch.observation_space.shape
    for module, fault in ((Acting(size, 2), "2 components"), (Whim(size), "not deterministic")):
        policy = load_policy("a.pt", torchscript(tmp_path / "a.pt", module))
        line = why(play, cfgs, policy, "a.pt")
        assert line.startswith("a.pt ") and fault in line
