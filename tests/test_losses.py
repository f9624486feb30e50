"""Loss terms: measures against plain formulas, gradients against differences, custom terms."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

import reference_mpm as reference
from plab.cli.run import main
from plab.config import ConfigError, load_config
from plab.envs.autograd import simulate
from plab.losses import TERMS, check_gradient, make_terms
from plab.losses.chamfer import POINTS
from plab.losses.gradient_check import gradient_errors
from plab.losses.term import DistanceTerm
from plab.objective import mass_portions, soft_iou
from plab.results import check, load, read
from plab.scenes import MANIPULATOR_SHAPES, Scene
from plab.sim import SimulationError, Simulator
from plab.sim.compiler import ti
from suite import KINDS, Kinetic, scene, tools
from toy_runner import COARSE

ROOT = Path(__file__).resolve().parents[1]
OWN = ROOT / "examples" / "own_loss"
SCENES = [scene(KINDS), scene(("Sphere", "Chopsticks"))]


class Close(DistanceTerm):
    """Smooth count of the particles near a manipulator."""

    @ti.func
    def add(self, accumulator, d, particle):
        """Add the contribution of one particle."""
        wide = ti.cast(d, ti.f64)
        return accumulator + ti.Vector([ti.exp(-wide * wide / 0.02), 0.0])

    @ti.func
    def measure(self, accumulator):
        """Logarithm of the count."""
        return ti.log(1.0 + accumulator[0])

    @ti.func
    def slope(self, accumulator, d, particle):
        """Derivative with respect to the distance."""
        wide = ti.cast(d, ti.f64)
        return -2.0 * wide / 0.02 * ti.exp(-wide * wide / 0.02) / (1.0 + accumulator[0])


def with_tools(*kinds: str) -> list[Scene]:
    """Scenes with only some of their manipulators, because kernels for all seven compile slowly."""
    return [replace(made, manipulators=tools(made, kinds)) for made in SCENES]


def distances(simulator: Simulator, e: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances of all particles from the moving manipulators, and normals: [manipulator, particle(, 3)]."""
    state, tools = simulator.state(), simulator.scenes[e].manipulators
    x = torch.tensor(state.x[e])
    pairs = [
        reference.signed_distance(tool, torch.tensor(pose), x)
        for tool, pose in zip(tools, state.poses[e], strict=True)
        if MANIPULATOR_SHAPES[tool.shape].motion != "static"
    ]
    return np.stack([d.numpy() for d, _ in pairs]), np.stack([n.numpy() for _, n in pairs])


def test_terms_that_do_not_exist_are_named() -> None:
    for overrides, named in (
        (["+method.loss_weights.densty=1"], "method.loss_weights.densty"),
        (["method.loss_terms.contact=sofd"], "method.loss_weights.contact: .*'sofd'"),
        (["+method.loss_terms.points=soft"], "method.loss_terms.points"),
        (["method.loss_weights={density:0,sdf:0,contact:0}"], "method.loss_weights"),
    ):
        with pytest.raises(ConfigError, match=named):
            load_config(overrides)
    owns = {"no_module:Term": "no_module", "plab.losses.density:Dense": "Dense"}
    for own, named in (owns | {"plab.objective:Scores": "Scores"}).items():
        with pytest.raises(ConfigError, match=named):
            make_terms({"own": 1.0}, {"own": own})


def test_a_term_of_weight_0_is_not_there(device: str) -> None:
    bare = Simulator(with_tools("Sphere"), device=device)
    terms = make_terms({"density": 0.0, "contact": 2.0})
    simulator = Simulator(bare.scenes, terms=terms, device=device)
    assert [term.name for term in simulator.terms] == ["contact"]
    assert simulator.losses().shape == (2, 1) and list(simulator._engine.references) == ["mass"]
    with pytest.raises(ValueError, match="'density'"):
        simulator.set_weights({"density": 1.0})
    assert bare.measure().terms.shape == (2, 0) and np.isnan(bare.measure().iou).all()
    with pytest.raises(ValueError, match="no loss"):
        bare.rollout(np.zeros((2, 1, bare.action_dim)))


def test_a_term_of_ones_own_is_a_file_and_a_weight(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    command = ["--config-dir", str(OWN / "conf"), "task=RollingPin", *COARSE, "method=adam_height"]
    assert main([*command, "method.iterations=2"]) == 0 and capsys.readouterr().err == ""
    run = read(load(tmp_path / "results")["path"][0])
    columns = ["loss_density", "loss_sdf", "loss_contact", "loss_height"]
    assert [name for name in run.iterations if name.startswith("loss_")] == columns
    total = run.iterations[columns].to_numpy() @ [10.0, 10.0, 1.0, 20.0]
    np.testing.assert_allclose(run.iterations["loss"], total, rtol=1e-6)
    assert run.labels["loss_height"].endswith("height above a surface [mass x domain units]")
    assert (run.iterations["loss_height"] > 0).all()
    assert [problem for _, problem in check(tmp_path / "results")] == [""]


def test_a_wrong_measure_or_gradient_is_noticed(device: str) -> None:
    class Wrong(Kinetic):
        @ti.func
        def gradient(self, e, x, v):
            return 2.0 * ti.Vector([0.0, 0.5, 0.0]) * v.dot(v), v * x[1]

    class Vector(Kinetic):
        @ti.func
        def measure(self, e, x, v):
            return v

    for wrong, named in ((Vector(), "Tensor"), ("density", "not 'density'")):
        with pytest.raises(Exception, match=named):
            check_gradient(wrong, with_tools("Sphere"), device=device)
    errors = check_gradient(Wrong(), with_tools("Sphere"), device=device, directions=1)
    assert errors["x"] == pytest.approx(0.5) and max(errors["v"], errors["poses"]) < 1e-6


NAMES = {name: name for name in TERMS} | {"energy": "suite:Kinetic", "close": f"{__name__}:{Close.__name__}"}
"""Terms of the simulator with all gradients."""


@pytest.fixture(scope="module")
def full(device: str) -> Simulator:
    """Simulator with all gradients and all terms."""
    scenes = with_tools("Sphere", "Chopsticks", "Cylinder")
    terms = make_terms(dict.fromkeys(NAMES, 1.0), NAMES)
    simulator = Simulator(scenes, terms=terms, precision="float64", device=device, full_gradient=True)
    target = np.random.default_rng(0).random((2, *[simulator.grid_size] * 3))
    simulator.set_target(target, target)
    return simulator


@pytest.mark.parametrize("name", [name for name in NAMES if name != "all"])
def test_gradients_of_terms_are_those_of_their_measures(name: str, full: Simulator) -> None:
    (term,) = (term for term in full.terms if term.name == name)
    errors = gradient_errors(full, term)
    assert max(errors.values()) < 1e-6, errors


def test_chamfer_is_that_of_particles_and_points_of_the_target(full: Simulator) -> None:
    full.reset()
    mass = np.random.default_rng(0).random((2, *[full.grid_size] * 3)) ** 8
    full.set_target(mass, mass)
    for _ in range(2):
        got = full.losses()[:, list(NAMES).index("chamfer")]
    for e, x in enumerate(full.state().x):
        square = cdist(x, mass_portions(mass[e], POINTS)) ** 2
        assert got[e] == pytest.approx(square.min(axis=0).mean() + square.min(axis=1).mean(), rel=1e-5)


def test_measures_are_the_formulas_and_the_gradient_of_all_is_summed(full: Simulator) -> None:
    """Term ``all`` has no true gradient: 2 w D sum of grad d_p over particles outside, measure D."""
    full.reset()
    rng = np.random.default_rng(0)
    shape = (full.batch, *[full.grid_size] * 3)
    target, sdf = SCENES[0].particle_mass * rng.random(shape), rng.random(shape)
    full.set_target(target, sdf)
    full.step(rng.uniform(-1.0, 1.0, (full.batch, full.action_dim)))
    measured, mass, state = full.measure(), full.mass_tensor(), full.state()
    full.set_weights(dict.fromkeys(NAMES, 0.0) | {"all": 3.0})
    gradient = full.loss_gradient()
    for e in range(len(SCENES)):
        signed, normals = distances(full, e)
        d = np.maximum(signed, 0.0)
        w = 1.0 / (1.0 + 1e4 * d**2)
        nearest = d.min(axis=1)
        want = {
            "density": np.abs(mass[e] - target[e]).sum(),
            "sdf": (mass[e] * sdf[e]).sum(),
            "nearest": (nearest**2).sum(),
            "all": (nearest**2).sum(),
            "soft": (((w * d).sum(axis=1) / w.sum(axis=1)) ** 2).sum(),
            "energy": (0.5 * (state.v[e] ** 2).sum(axis=1) * state.x[e, :, 1]).sum(),
        }
        got = dict(zip(NAMES, measured.terms[e], strict=True))
        np.testing.assert_allclose([got[name] for name in want], list(want.values()), rtol=1e-9)
        assert measured.iou[e] == pytest.approx(soft_iou(mass[e], target[e]), rel=1e-9)
        pulls = (6.0 * nearest[:, None] * (signed > 0))[..., None] * normals
        np.testing.assert_allclose(gradient.x[e], pulls.sum(axis=0), atol=1e-9 * np.abs(pulls).max())
        # Manipulators are pulled the other way.
        moving = [m.shape != "Cylinder" for m in full.scenes[e].manipulators]
        back = -pulls.sum(axis=1)
        np.testing.assert_allclose(gradient.poses[e, moving, :3], back, atol=1e-9 * np.abs(pulls).sum())
    # Where mass and target are equal, the density's slope is 0, halfway between -1 and 1.
    full.set_weights(dict.fromkeys(NAMES, 0.0) | {"density": 1.0})
    pulls = []
    for share in (1.0, 0.5):
        full.set_target(mass * np.where(np.arange(full.grid_size) < 16, share, 2.0), sdf)
        pulls.append(full.loss_gradient().x)
    np.testing.assert_allclose(pulls[1], 2.0 * pulls[0], atol=1e-9 * np.abs(pulls[0]).max())


def test_the_way_back_is_refused_once_it_is_gone(full: Simulator) -> None:
    full.reset()
    u = torch.zeros((2, 2, full.action_dim), requires_grad=True)
    states = simulate(full, u, every_step=False)
    assert states.x.shape == (2, 1, full.particle_count, 3) and states.mass.shape[:2] == (2, 1)
    np.testing.assert_allclose(states.mass[:, 0].detach(), full.mass_tensor(), atol=1e-9)
    full.reset()
    with pytest.raises(RuntimeError, match="pull back"):
        states.x.sum().backward()
    with pytest.raises(RuntimeError, match="no gradient of the last"):
        full.state_gradient()
    with pytest.raises(TypeError, match="'y'"):
        simulate(full, u, y=u)
    with pytest.raises(ValueError, match=r"to v .*\(2, 1\)"):
        full.record(np.zeros((2, 1, full.action_dim))).pullback(v=np.zeros((2, 1)))
    full.reset()
    broken = full.state()
    broken.v[0, 0] = 1e9
    full.set_initial_state(broken)
    with pytest.raises(SimulationError, match="environment 0"):
        full.record(np.zeros((2, 1, full.action_dim)))
