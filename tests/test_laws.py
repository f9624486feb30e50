"""Constitutive laws: formulas, closed forms, adjoints, compiled functions and their cache."""

import ctypes
import dataclasses
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import laws
from pages import ROOT, blocks
from plab.config import ConfigError, build_scene, load_config
from plab.laws import Law, viscoplastic
from plab.laws.algebra import Series
from plab.scenes import LAWS, Body, Material, Scene, SceneError, find_law
from plab.sim import DeviceError, Simulator
from plab.sim.codegen import bitcode
from plab.sim.compiler import ti
from plab.sim.cuda_sums import add
from plab.sim.runtime import start_runtime
from suite import instructions_of_the_host

sys.path.append(str(ROOT / "examples" / "own_law"))
SNOW = find_law("snow:SNOW")
"""The law of docs/own_law.md."""

ALL = {**LAWS, SNOW.name: SNOW}

DT = 1e-4
CONSTANTS = (DT, 0.5, 0.3)
"""Time step, scale of the stress in A, and mass."""

OWN = {"von_mises": {"yield_stress": 20.0}, "viscoplastic": {"yield_stress": 20.0, "exponent": 0.6}}
"""Values that differ from the defaults, so that some particles yield."""

COUNT = 600


def coefficients(law: Law, **values: float) -> list[float]:
    return law.coefficients_of({**law.defaults, **OWN.get(law.name, {}), **values})


def deformed(strain: float) -> tuple[np.ndarray, np.ndarray]:
    """C and F of slightly compressed particles, [9, particle]."""
    rng = np.random.default_rng(0)
    f = 0.99 * np.eye(3).reshape(9, 1) + strain * rng.normal(size=(9, COUNT))
    return 30.0 * rng.normal(size=(9, COUNT)), f


def table(values: object) -> np.ndarray:
    """Array [component, particle] of components, some of which are constant."""
    return np.array(np.broadcast_arrays(*values, np.zeros(COUNT))[: len(values)])


def updated(law: Law, c: np.ndarray, f: np.ndarray, *own: object) -> tuple[np.ndarray, np.ndarray]:
    """A (9) and the new F (9) of particles."""
    materials = pytest.importorskip("plab.sim.codegen.materials")
    tau, new = law.update(c, f, DT, *own)
    return table(materials.scattered_matrix(tau, c, *CONSTANTS[1:])), table(new)


# ----------------------------------------------------------------------------------------------- formulas


def sheared(law: Law, own: list[float], rate: float, steps: int, squeeze: float = 1.0) -> np.ndarray:
    """Kirchhoff stress (6) after steps of simple shear in the xy plane."""
    c, f = np.zeros(9), squeeze * np.eye(3).reshape(9)
    c[1] = rate
    for _ in range(steps):
        tau, f = law.update(c, np.array(f, float), DT, *own)
    return np.array(tau, float)


def test_shear_follows_closed_forms() -> None:
    """Elastic: mu gamma, and a normal stress mu gamma^2. Fluid: eta times the rate. Herschel-Bulkley: yield
    stress and consistency times a power of the rate. Sand: the pressure times its friction."""
    mu, lam = coefficients(LAWS["elastic"])
    tau = sheared(LAWS["elastic"], [mu, lam], 10.0, 100)
    np.testing.assert_allclose(tau[[0, 1, 3]], [mu * 0.01, 0.0, mu * 0.1], atol=1e-9)
    assert sheared(LAWS["fluid"], [5000.0, 2.0], 10.0, 5)[3] == pytest.approx(20.0)
    for exponent in (1.0, 0.5):
        own = coefficients(LAWS["viscoplastic"], yield_stress=20.0, consistency=3.0, exponent=exponent)
        tau = sheared(LAWS["viscoplastic"], own, 10.0, 3000)
        assert tau[3] == pytest.approx(20.0 / math.sqrt(2.0) + 3.0 * 10.0**exponent, rel=2e-3)
    sand = LAWS["drucker_prager"]
    own = sand.coefficients_of(sand.defaults)
    tau = sheared(sand, own, 10.0, 3000, squeeze=0.999)
    pressure = -tau[:3].sum() / 3.0
    assert pressure == pytest.approx((own[1] + 2.0 * own[0] / 3.0) * -3.0 * math.log(0.999), rel=1e-6)
    deviator = np.sqrt(((tau[:3] + pressure) ** 2).sum() + 2.0 * (tau[3:] ** 2).sum())
    assert deviator == pytest.approx(3.0 * own[2] * pressure, rel=1e-6)


def test_triaxial_compression_of_sand_fails_by_mohr_and_coulomb() -> None:
    """The smaller principal stress is (1 - sin phi) / (1 + sin phi) times the larger one."""
    sand = LAWS["drucker_prager"]
    for angle in (20.0, 35.0):
        f = np.diag([0.98, 1.004, 1.004]).reshape(9)
        tau, _new = sand.update(np.zeros(9), f, DT, *coefficients(sand, friction_angle=angle))
        sine = math.sin(math.radians(angle))
        assert tau[1] / tau[0] == pytest.approx((1.0 - sine) / (1.0 + sine), rel=1e-9)


def test_separated_sand_carries_nothing_until_it_is_back_at_its_volume() -> None:
    sand = LAWS["drucker_prager"]
    f, seen = np.eye(3).reshape(9), []
    for rate in (200.0, 200.0, -200.0, -150.0, -60.0):
        tau, f = sand.update(rate * np.eye(3).reshape(9), np.array(f), DT, *coefficients(sand))
        seen.append(tau[0])
    assert np.abs(seen[:4]).max() == 0.0 and seen[4] < -1.0


def principal_stress(law: str, strain: np.ndarray, own: list[float]) -> np.ndarray:
    """Principal Kirchhoff stresses after a substep, in closed form, given principal Hencky strains."""
    mu, lam, *more = own
    trace, j = strain.sum(), math.exp(strain.sum())
    if law == "elastic":
        return mu * np.expm1(2.0 * strain) + lam * j * (j - 1.0)
    deviator, norm = strain - trace / 3.0, np.linalg.norm(strain - trace / 3.0)
    pressure = (lam + 2.0 * mu / 3.0) * trace
    if law == "drucker_prager":
        return 2.0 * mu * min(1.0, -1.5 * more[0] * pressure / mu / norm) * deviator + pressure
    over, consistency = 2.0 * mu * norm - more[0], math.exp(more[1]) / math.sqrt(2.0)
    carried = more[0] + over / (1.0 + mu * DT / consistency) if over > 0.0 else 2.0 * mu * norm
    return carried * deviator / norm + pressure


def test_blocks_carry_the_stress_of_closed_forms() -> None:
    """In uniaxial compression and in simple shear under pressure, elastic and yielding.

    The stress of a body is the change of the moment of its momentum in a substep.
    """
    names, grid, edge = ("elastic", "drucker_prager", "viscoplastic"), 32, 6
    block = laws.lattice(edge, edge, edge) / grid
    bodies = tuple(Body("box", (0.5,) * 3, (0.1,) * 3, len(block), law=name) for name in names)
    scene = Scene("blocks", bodies, (), gravity=(0.0, 0.0, 0.0), grid_size=grid, dt=DT, substeps=1)
    x = np.concatenate([np.add(block, [0.13 + 0.28 * k, 0.4, 0.4]) for k in range(3)])
    sim = Simulator([scene] * 2, precision="float64", particles=[x] * 2)
    for size in (1e-3, 0.02):
        f = np.tile(np.eye(3), (2, 1, 1))
        f[0, 0, 0] = 1.0 - size
        f[1] *= 0.999
        f[1, 0, 1] = 0.999 * size
        sim.reset()
        start = sim.state()
        sim.set_state(dataclasses.replace(start, F=np.tile(f[:, None], (1, len(x), 1, 1))))
        sim.step(np.zeros((2, 0)))
        end, half = sim.state(), math.asinh(0.5 * size)
        axes = np.eye(3)
        turn = 0.5 * math.atan2(2.0, size)
        axes[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        strains = np.array([math.log(1.0 - size), 0.0, 0.0]), np.array([half, -half, 0.0]) + math.log(0.999)
        for k, material in enumerate(scene.materials):
            mine = scene.particle_bodies == k
            own = material.kind.coefficients_of(material.values)
            for e, (strain, frame) in enumerate(zip(strains, (np.eye(3), axes), strict=True)):
                spread = end.v[e, mine].T @ start.x[e, mine] / mine.sum()
                moment = spread + end.C[e, mine].mean(0) / (2 * grid) ** 2
                wanted = frame @ np.diag(principal_stress(material.law, strain, own)) @ frame.T
                np.testing.assert_allclose(-moment / DT, wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("case", "cells", "tolerance"),
    [
        ("swirl", 8, 0.03),
        ("layer", 8, 0.03),
        pytest.param("collapse", 8, 0.4, marks=pytest.mark.nightly),
        pytest.param("dam", 6, 0.5, marks=pytest.mark.nightly),
    ],
)
def test_fluids_and_sand_move_as_in_theory_and_experiments(case: str, cells: int, tolerance: float) -> None:
    """Viscosity, weight, a sand column's run-out and height, the front behind a broken dam."""
    for what, value, wanted in laws.CASES[case][0](cells):
        assert value == pytest.approx(wanted, abs=tolerance), what


def test_a_bingham_body_rests_below_its_yield_stress_and_slumps_above(monkeypatch) -> None:
    kept: list[Simulator] = []

    def shared(scenes, **options) -> Simulator:
        kept[:] = kept or [Simulator(scenes, **options)]
        kept[0].set_scenes(scenes, **options)
        return kept[0]

    monkeypatch.setattr(laws, "Simulator", shared)
    rests, *slumps = [value for _what, value, _wanted in laws.slump(6)]
    assert abs(rests) < 0.01 and 0.1 < slumps[0] < slumps[1] - 0.1 < 0.4


# ----------------------------------------------------------------------------------------------- adjoints


@pytest.mark.parametrize("name", [name for name in ALL if name != "von_mises"])
@pytest.mark.parametrize("strain", [0.0, 1e-4, 0.01, 0.1])
def test_adjoints_of_laws_are_central_differences(name: str, strain: float) -> None:
    """Differentiate by C, F and each coefficient, also where all stretches are equal."""
    from plab.sim.codegen.materials import law_adjoint

    law, (c, f) = ALL[name], deformed(strain)
    rng = np.random.default_rng(1)
    a_bar, f_bar = rng.normal(size=(2, 9, COUNT))
    own = [np.full(COUNT, value) for value in coefficients(law)]
    bars = law_adjoint(law, c, f, own, CONSTANTS, a_bar, f_bar)
    ways = [30.0 * rng.normal(size=c.shape), 0.01 * rng.normal(size=f.shape)]
    ways.append([value * rng.normal(size=COUNT) for value in own])

    def loss(step: float) -> np.ndarray:
        given = [x + step * way for x, way in zip(own, ways[2], strict=True)]
        a, new = updated(law, c + step * ways[0], f + step * ways[1], *given)
        return (a_bar * a).sum(axis=0) + (f_bar * new).sum(axis=0)

    h = 1e-4
    slope = (8.0 * (loss(h) - loss(-h)) - (loss(2.0 * h) - loss(-2.0 * h))) / (12.0 * h)
    wanted = sum((table(bar) * way).sum(axis=0) for bar, way in zip(bars, ways, strict=True))
    error = np.abs(slope - wanted) / (np.abs(wanted) + 0.1 * np.abs(wanted).mean())
    # At kinks, such as the onset of yield, the slopes of both sides differ.
    assert np.quantile(error, 0.99) < 1e-6


@pytest.mark.parametrize("name", ALL)
def test_parameters_are_differentiated_and_limit_the_time_step(name: str) -> None:
    law = ALL[name]
    values = {**law.defaults, **OWN.get(name, {})}
    bars = np.random.default_rng(2).normal(size=law.size) / coefficients(law)
    for key, slope in zip(law.keys, law.parameter_gradient(values, bars), strict=True):
        up, down = ({**values, key: values[key] * (1.0 + sign * 1e-6)} for sign in (1, -1))
        rise = bars @ np.subtract(law.coefficients_of(up), law.coefficients_of(down))
        assert slope == pytest.approx(rise / (2e-6 * values[key]), rel=1e-6, abs=1e-9), key
    assert 0.0 < law.largest_step(values, 0.01) < 0.01
    for parameter in law.parameters:
        assert parameter.admits(parameter.default) and not parameter.admits(-1.0)


# ----------------------------------------------------------------------------------------------- compiled


def compiled(device: str, precision: str, law: Law, mixed: bool = False):
    """Function that calls a law's bitcode functions by name with arrays."""
    llvm = pytest.importorskip("llvmlite.binding")
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    host = llvm.Target.from_default_triple().create_target_machine(opt=0)
    with instructions_of_the_host():
        module = llvm.parse_bitcode(bitcode._code(device, precision, law, mixed))
    module.triple, module.data_layout = llvm.get_default_triple(), str(host.target_data)
    engine = llvm.create_mcjit_compiler(module, host)
    engine.finalize_object()

    def call(name: str, *arrays: np.ndarray) -> None:
        address = engine.get_function_address(bitcode.symbol(law, name, precision))
        ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(arrays))(address)(*[a.ctypes.data for a in arrays])

    call.engine = engine
    return call


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize(("name", "strain"), [*((name, 0.01) for name in ALL), ("von_mises", 0.3)])
def test_compiled_laws_compute_their_formulas(name: str, strain: float, precision: str) -> None:
    """Check a tile on the CPU, a tile with two laws, and a particle on CUDA, forward and adjoint; von Mises
    plasticity on CUDA by series and by singular values."""
    from plab.sim.codegen.materials import law_adjoint
    from plab.sim.storage import AT_C, AT_F, LAW_PARAMETER_BARS, LAW_PARAMETERS, STATE, STRAIN_LAW, STRAINS

    law, lanes = ALL[name], 8
    kind, tolerance = (np.float32, 1e-4) if precision == "f32" else (np.float64, 1e-13)
    rng = np.random.default_rng(3)
    state, bar = rng.normal(size=(2, STATE, lanes)).astype(kind)
    state[AT_C:AT_F], state[AT_F:] = (x[:, :lanes] for x in deformed(strain))
    affine, own = rng.normal(size=(9, lanes)).astype(kind), coefficients(law)
    c, f = (x.astype(float) for x in (state[AT_C:AT_F], state[AT_F:]))
    a, f_new = (x[:, :lanes] for x in updated(law, *deformed(strain), *own))
    spread = [np.full(lanes, value) for value in own]
    c_bar, f_bar, own_bar = (
        np.array(np.broadcast_arrays(*x, c[0])[: len(x)])
        for x in law_adjoint(law, c, f, spread, CONSTANTS, affine.astype(float), bar[AT_F:].astype(float))
    )

    def close(got: np.ndarray, want: np.ndarray) -> None:
        np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * np.abs(want).max())

    numbers = [np.array([value], kind) for value in (1.0, *CONSTANTS)]
    for mixed in (False, True):
        strains, out, new = np.zeros((STRAINS, lanes), kind), np.zeros((9, lanes), kind), state.copy()
        strains[LAW_PARAMETERS : LAW_PARAMETERS + law.size] = np.array(own)[:, None]
        mine = np.arange(lanes) % 3 > 0 if mixed else np.full(lanes, True)
        strains[STRAIN_LAW] = mine
        call = compiled("cpu", precision, law, mixed)
        at = [np.array([x.ctypes.data], np.uint64) for x in (strains, state, out, new)]
        call("update", *at, *numbers)
        close(out[:, mine], a[:, mine])
        close(new[AT_F:, mine], f_new[:, mine])
        assert (out[:, ~mine] == 0.0).all() and (new[:, ~mine] == state[:, ~mine]).all()
        given = bar.copy()
        at = [np.array([x.ctypes.data], np.uint64) for x in (strains, state, affine, given)]
        call("adjoint", *at, *numbers)
        close(given[AT_C:AT_F, mine], c_bar[:, mine])
        close(given[AT_F:, mine], f_bar[:, mine])
        assert (given[:, ~mine] == bar[:, ~mine]).all()
        bars = strains[LAW_PARAMETER_BARS : LAW_PARAMETER_BARS + law.size]
        close(bars[:, mine] * np.array(own)[:, None], own_bar[:, mine] * np.array(own)[:, None])
    call, series = compiled("cuda", precision, law), Series.for_precision(f"float{precision[1:]}")
    if name == "von_mises":
        numbers += [np.array([x], kind) for x in (series.z_squared_max, series.j_min, series.j_max)]
    held = [np.array([x], kind) for x in (*state[AT_C:, 0], *own)]
    call("particle", *held, *numbers[1:])
    close(np.ravel(held[:9]), a[:, 0])
    close(np.ravel(held[9:18]), f_new[:, 0])
    held = [np.array([x], kind) for x in (*state[AT_C:, 0], *affine[:, 0], *bar[AT_F:, 0], *own)]
    call("particle_adjoint", *held, *numbers[1:])
    close(np.ravel(held[:9]), c_bar[:, 0])
    close(np.ravel(held[9:18]), f_bar[:, 0])


def test_compiled_laws_are_kept_in_the_cache(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path / "cache"))
    given = ("cpu", "f32", LAWS["elastic"])
    path = Path(bitcode.bitcode_file.__wrapped__(*given))
    assert path.parent == tmp_path / "cache" / "laws" and list(path.parent.iterdir()) == [path]
    time = path.stat().st_mtime_ns
    assert bitcode.bitcode_file.__wrapped__(*given) == str(path) and path.stat().st_mtime_ns == time
    # Without a cache, a folder of the process serves; without llvmlite, one line says so.
    (tmp_path / "file").touch()
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path / "file"))
    other = Path(bitcode.bitcode_file.__wrapped__(*given))
    assert other != path and other.name == path.name and other.exists()
    # Without llvmlite, a simulator says so before Taichi compiles a kernel; likewise for a law's mistakes.
    shutil.rmtree(other.parent)
    bitcode.bitcode_file.cache_clear()
    monkeypatch.syspath_prepend(tmp_path)
    line = "{0} = replace(ELASTIC, name='{0}', update=lambda c, f, *_: ([{1}] * 6, f))\n"
    text = "from dataclasses import replace\nimport numpy as np\nfrom plab.laws.elastic import ELASTIC\n"
    text += line.format("A", "1.0 if c[0] < 0.0 else 2.0") + line.format("B", "np.arctan(c[0])")
    text += line.format("C", "0.0, c[0]") + "D = replace(ELASTIC, stiffness=float)\n"
    (tmp_path / "wrong.py").write_text(text)
    for law, kind, named in (
        ("wrong:A", ConfigError, r"law A of \S+wrong.py cannot .* use np.where"),
        ("wrong:B", ConfigError, "np.arctan of a component"),
        ("wrong:C", ConfigError, "6 stresses and 9 numbers of F, not 12 and 9"),
        ("wrong:D", SceneError, "law wrong:D: coefficients, stiffness or viscosity fail: float expected"),
        ("elastic", DeviceError, "compiles its laws with llvmlite"),
    ):
        if law == "elastic":
            monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
        bodies = (Body("sphere", (0.5,) * 3, (0.1,), 9, law=law),)
        with pytest.raises(kind, match=named):
            Simulator([Scene("one", bodies, ())], precision="float64")


def test_many_threads_add_to_numbers_of_a_field() -> None:
    start_runtime("cpu", "float32")
    values = np.arange(1, 1001)
    for kind, size in ((ti.f32, 4), (ti.f64, 8), (ti.i64, 8)):
        sums = ti.Vector.field(4, kind, shape=3)

        @ti.kernel
        def add_all(given: ti.types.ndarray()):
            for i in range(given.shape[0]):
                add(kind, ti.get_addr(sums, 0) + ti.cast(size * (4 * (i % 3) + 2), ti.u64), given[i])  # noqa: B023

        add_all(values)
        expected = np.zeros((3, 4))
        expected[:, 2] = [values[k::3].sum() for k in range(3)]
        np.testing.assert_array_equal(sums.to_numpy(), expected)


def test_laws_are_found_by_name() -> None:
    assert Material(5000.0, 0.2, 50.0).kind is LAWS["von_mises"]
    with pytest.raises(ValueError, match="law 'drucker' does not exist; choose from: von_mises"):
        find_law("drucker")
    with pytest.raises(ValueError, match=r"parameters\.youngs_modulus is not one of law elastic \(none\)"):
        Material(5000.0, 0.2, 50.0, "elastic", (("youngs_modulus", 1.0),)).validate()
    with pytest.raises(ValueError, match=r"friction_angle 95 is outside \[0, 90\)"):
        Material(5000.0, 0.2, 50.0, "drucker_prager", (("friction_angle", 95.0),)).validate()


@pytest.mark.parametrize("power", [0.5, 1.0, 5.0])
def test_overstress_solves_its_equation(power: float) -> None:
    trial, root = np.geomspace(1e-6, 1e6, 500)[:, None], math.sqrt(2.0)
    consistency = np.geomspace(1e-4, 1e4, 9)
    x = viscoplastic.overstress(trial, DT, 2000.0, np.log(root * consistency), power)
    flow = root * 2000.0 * DT * (x / (root * consistency)) ** power
    np.testing.assert_allclose(x + flow, np.broadcast_to(trial, x.shape), rtol=1e-12)


def test_the_page_on_laws_shows_its_example_and_what_it_prints(capsys) -> None:
    law, trial = blocks("own_law.md", "python")
    assert law == (ROOT / "examples/own_law/snow.py").read_text(encoding="utf-8")
    task = (ROOT / "examples/own_law/conf/task/Snow.yaml").read_text(encoding="utf-8")
    assert all(excerpt in task for excerpt in blocks("own_law.md", "yaml"))
    exec(law + trial, {})
    assert capsys.readouterr().out == blocks("own_law.md", "text")[0]
    cfg = load_config(["task=Snow", "variant=2"], ROOT / "examples/own_law/conf")
    (material,) = build_scene(cfg).materials
    assert material.kind is SNOW and material.values["compression"] == 0.01
