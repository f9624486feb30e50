"""The configuration: YAML against dataclasses, variants, checks, and the scenes that come out."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from plab.config import (
    GROUPS,
    ApgConfig,
    BodyConfig,
    Config,
    ConfigError,
    DrawConfig,
    ManipulatorConfig,
    MethodConfig,
    PodsConfig,
    PpoConfig,
    ProtocolConfig,
    RandomConfig,
    SacConfig,
    ShacConfig,
    SimConfig,
    TaskConfig,
    Td3Config,
    TrajectoryConfig,
    build_scene,
    choices,
    conf_folder,
    load_config,
)
from plab.scene import SceneError

YAML_FILES = sorted(conf_folder().rglob("*.yaml"))
KEY_LINE = re.compile(r'^ *["\w]+: ?')
VARIANTS = [(task, variant) for task in choices("task") for variant in range(1, 6)]
OPTIONAL = {
    "gap",
    "minimal_gap",
    "variant",
    "shift",
    "reach",
    "ranges",
    "random",
    "release",
    "file",
    "sha256",
}
"""Fields that a YAML may leave out: those of chopsticks, and what variant=random draws, and
what the release has in other numbers."""

OWN_MATERIAL = {"youngs_modulus", "poisson_ratio", "yield_stress"}
"""Fields that a body may leave out, but no task."""

DOCUMENTED = (
    Config,
    TaskConfig,
    BodyConfig,
    ManipulatorConfig,
    RandomConfig,
    DrawConfig,
    TrajectoryConfig,
    ApgConfig,
    SacConfig,
    ShacConfig,
    Td3Config,
    PpoConfig,
    ProtocolConfig,
    SimConfig,
)

METHOD_KINDS = {
    "adam": TrajectoryConfig,
    "apg": ApgConfig,
    "sac": SacConfig,
    "pods": PodsConfig,
    "shac": ShacConfig,
    "td3": Td3Config,
    "ppo": PpoConfig,
}
"""Type of each method's file that does not build on another."""

SUITE = {
    "Move": (200, 10000, 6),
    "TripleMove": (200, 9999, 18),
    "Torus": (50, 10000, 3),
    "Rope": (200, 10000, 6),
    "Writer": (50, 10000, 3),
    "Pinch": (50, 6000, 3),
    "RollingPin": (50, 10000, 3),
    "Chopsticks": (200, 10000, 7),
    "Table": (50, 10000, 3),
    "Assembly": (100, 10000, 6),
}
"""Yield stress, particles and length of the action vector of each task."""


def names(kind: type) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def keys(node: Any) -> set[str]:
    return set(node) - {"defaults", "hydra"}


def paths(node: Any, prefix: str = "") -> set[str]:
    """Dotted paths of the leaves of nested mappings."""
    if not isinstance(node, dict):
        return {prefix}
    return set().union(*(paths(value, f"{prefix}.{key}") for key, value in node.items()))


def raw(path: str) -> Any:
    return OmegaConf.to_container(OmegaConf.load(conf_folder() / path))


# ------------------------------------------------------------------------------ YAML and dataclasses


@pytest.mark.parametrize("path", YAML_FILES, ids=lambda path: path.relative_to(conf_folder()).as_posix())
def test_every_key_has_a_comment(path: Path):
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("# "), "the first line says what the file is; --help prints it"
    bare = [
        line for line in lines if KEY_LINE.match(line) and "# " not in line and line.strip() != "defaults:"
    ]
    assert bare == []


def test_root_keys_are_the_fields():
    assert keys(raw("config.yaml")) | set(GROUPS) == names(Config)


@pytest.mark.parametrize("name", choices("protocol"))
def test_protocol_keys_are_the_fields(name):
    protocol = raw(f"protocol/{name}.yaml")
    assert keys(protocol) == names(ProtocolConfig)
    assert protocol["name"] == name


def test_sim_keys_are_the_fields():
    assert keys(raw("sim/fast.yaml")) == names(SimConfig)


@pytest.mark.parametrize("name", METHOD_KINDS)
def test_method_keys_are_the_fields(name):
    method = raw(f"method/{name}.yaml")
    assert keys(method) == names(METHOD_KINDS[name])
    assert {**method["loss_weights"], "contact": 1.0} == {"density": 10.0, "sdf": 10.0, "contact": 1.0}
    assert (method["loss_weights"]["contact"] == 1.0) == (name != "adam")
    assert method["loss_terms"] == {"contact": "${protocol.contact}"}


@pytest.mark.parametrize("name", ["sac", "td3", "ppo"])
def test_profiles_hold_the_values_that_refer_to_them(name):
    method = raw(f"method/{name}.yaml")
    referring = {key for key, value in method.items() if str(value).startswith("${")}
    assert {f"${{.profiles.${{.profile}}.{key}}}" for key in referring} == {method[key] for key in referring}
    assert [set(profile) for profile in method["profiles"].values()] == [referring] * 2
    assert list(method["profiles"]) == ["paper", "release"]


def test_a_profile_gives_the_numbers_and_overrides_win():
    paper, release = (load_config(["method=sac", f"method.profile={p}"]).method for p in ("paper", "release"))
    assert (paper.tau, paper.learning_starts, paper.profiles) == (3e-4, 1000, {})
    assert (release.tau, release.learning_starts, release.profiles) == (0.005, 2500, {})
    assert load_config(["method=sac"]).method == release
    assert load_config(["method=sac", "method.profile=paper", "method.tau=0.1"]).method.tau == 0.1


@pytest.mark.parametrize("task", choices("task"))
def test_task_keys_are_the_fields(task):
    content = raw(f"task/{task}.yaml")
    assert content["name"] == task
    assert keys(content) - OPTIONAL == names(TaskConfig) - OPTIONAL
    for body in content["bodies"].values():
        assert keys(body) - OPTIONAL == names(BodyConfig) - OPTIONAL - OWN_MATERIAL
    for manipulator in content["manipulators"].values():
        assert keys(manipulator) - OPTIONAL == names(ManipulatorConfig) - OPTIONAL


def test_dataclasses_have_no_defaults_of_their_own():
    given = {
        field.name
        for kind in DOCUMENTED
        for field in dataclasses.fields(kind)
        if field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
    }
    assert given == OPTIONAL | OWN_MATERIAL


@pytest.mark.parametrize("kind", DOCUMENTED)
def test_every_field_is_documented(kind):
    documented = "\n".join(base.__doc__ for base in kind.__mro__ if dataclasses.is_dataclass(base))
    assert all(re.search(rf"^\s*{name}: ", documented, re.MULTILINE) for name in names(kind))


@pytest.mark.parametrize("method", choices("method"))
@pytest.mark.parametrize("sim", choices("sim"))
def test_every_method_and_sim_composes(method, sim):
    cfg = load_config([f"method={method}", f"sim={sim}"])
    assert cfg.method.name == method
    assert isinstance(cfg, Config) and isinstance(cfg.method, MethodConfig)


def test_methods_differ_only_where_their_files_say():
    adam, gd, adam_h = (
        dataclasses.asdict(load_config([f"method={m}"]).method) for m in ("adam", "gd", "adam_h")
    )
    assert gd == adam | {"name": "gd", "optimizer": "gd", "lr": 100.0, "max_gradient_norm": 0.03}
    assert adam_h == adam | {"name": "adam_h", "contact": "hard"}


def test_an_experiment_presets_what_it_says():
    cfg = load_config(["+experiment=yield_ablation", "task.yield_stress=20"])
    assert (cfg.task.name, cfg.variant, cfg.method.name, cfg.task.yield_stress) == ("Move", "3", "sac", 20)
    # What it sweeps over is left to the sweep.
    assert load_config(["+experiment=yield_ablation"]).task.yield_stress == 200


def test_the_fast_recipe_is_ppo_with_large_batches():
    cfg, faithful = load_config(["+experiment=ppo_fast", "task=Torus"]), load_config(["method=ppo"])
    fast, slow = dataclasses.asdict(cfg.method), dataclasses.asdict(faithful.method)
    assert {key for key in slow if fast[key] != slow[key]} == {
        *("name", "episodes", "num_envs", "evaluate_every", "steps_per_update", "minibatches", "epochs"),
        "statistics_episodes",
    }


def test_reference_is_fast_in_float64():
    fast, reference = (dataclasses.asdict(load_config([f"sim={s}"]).sim) for s in ("fast", "reference"))
    assert reference == fast | {"precision": "float64"}


# ------------------------------------------------------------------------------ scenes and variants


@pytest.mark.parametrize(("task", "variant"), VARIANTS)
def test_every_variant_is_a_valid_scene(task, variant):
    scene = build_scene(load_config([f"task={task}", f"variant={variant}"]))
    assert scene.name == task
    assert scene.youngs_modulus == 5000
    assert scene.poisson_ratio == (0.05 if task == "Table" else 0.2)
    assert scene.gravity == (0, -150 if task == "Chopsticks" else -30, 0)
    assert (scene.grid_size, scene.dt, scene.substeps, scene.horizon) == (64, 1e-4, 19, 50)
    assert (scene.yield_stress, scene.particle_count, scene.action_dim) == SUITE[task]


@pytest.mark.parametrize("task", choices("task"))
def test_variants_of_a_task_set_the_same_keys(task):
    sets = [paths(variant) for variant in raw(f"task/{task}.yaml")["variants"].values()]
    if task == "Chopsticks":  # the paper's second is an easy one, straight ahead
        for key in ("turn", "x", "z"):
            sets[1].remove(f".target.{key}")
    assert all(other == sets[0] for other in sets)


@pytest.mark.parametrize("variant", range(1, 6))
def test_move_starts_with_the_spheres_on_either_side_of_the_ball(variant):
    scene = build_scene(load_config(["task=Move", f"variant={variant}"]))
    x, y, z = scene.bodies[0].center
    left, right = scene.manipulators
    assert left.position == pytest.approx((x - 0.1, y, z))
    assert right.position == pytest.approx((x + 0.1, y, z))
    assert (scene.floor_friction, left.size, left.friction) == (1.5, (0.03,), 0.9)


def test_rope_scene():
    scene = build_scene(load_config(["task=Rope", "variant=4"]))
    left, right, pillar = scene.manipulators
    assert [m.shape for m in scene.manipulators] == ["Sphere", "Sphere", "Cylinder"]
    assert (left.position, right.position) == ((0.22, 0.015, 0.82), (0.78, 0.015, 0.82))
    assert (pillar.position, pillar.size, pillar.scale) == ((0.4697, 0, 0.3868), (0.1, 0.2), ())
    assert left.scale == right.scale == (0.01, 0.01, 0.01)
    assert scene.bodies[0].size == (0.6, 0.06, 0.06)
    assert scene.floor_friction == 0.3
    assert left.rotation == (1, 0, 0, 0)


def test_a_loaded_configuration_is_plain_and_holds_its_own_variant_only():
    cfg = load_config(["task=Move", "variant=3"])
    assert cfg.task.bodies["ball"].size == [0.10759]
    assert list(cfg.task.variants) == ["3"]
    assert json.loads(json.dumps(dataclasses.asdict(cfg))) == dataclasses.asdict(cfg)
    cfg.variant = "4"
    with pytest.raises(ConfigError, match="variant 4 of task Move does not exist; choose from: 3"):
        build_scene(cfg)


def test_a_variant_may_change_anything_and_add_bodies():
    box = "{shape: box, center: [0.5, 0.3, 0.2], size: [0.1, 0.1, 0.1], particles: 10}"
    cfg = load_config(
        [
            f"+task.variants.1.bodies={{second: {box}}}",
            "+task.variants.1.yield_stress=7",
            "+task.variants.1.bodies.rope.particles=20",
        ]
    )
    scene = build_scene(cfg)
    assert scene.yield_stress == 7
    assert [body.particles for body in scene.bodies] == [20, 10]


def test_particles_scale():
    def count(scale: float) -> int:
        return build_scene(load_config([f"sim.particles_scale={scale}"])).particle_count

    assert (count(0.1), count(1), count(2.5), count(5e-5)) == (1000, 10000, 25000, 1)


def test_scalar_overrides_reach_the_scene():
    cfg = load_config(
        [
            "task.yield_stress=inf",
            "task.gravity=[0,-5,0]",
            "sim.dt=1.5e-4",
            "task.manipulators.left.friction=0",
        ]
    )
    scene = build_scene(cfg)
    assert scene.yield_stress == float("inf")
    assert scene.gravity == (0, -5, 0)
    assert scene.dt == 1.5e-4
    assert scene.manipulators[0].friction == 0
    assert scene.manipulators[1].friction == 0.9


def test_the_variant_is_a_string_and_seed_scene_is_left_out():
    cfg = load_config(["variant=3"])
    assert (cfg.variant, cfg.seed_scene, cfg.task.random) == ("3", None, {})
    assert cfg == load_config(["variant='3'"])


def test_a_variant_may_have_any_name():
    pillar = "{manipulators: {pillar: {position: [0.4, 0.1, 0.5]}}}"
    cfg = load_config([f"+task.variants.tall={pillar}", "variant=tall"])
    assert cfg.variant == "tall" and cfg.task.manipulators["pillar"].position == [0.4, 0.1, 0.5]


@pytest.mark.parametrize(
    ("overrides", "lr"),
    [
        (["task=Move"], 0.1),
        (["task=Chopsticks"], 0.01),
        (["task=Chopsticks", "method=gd"], 10.0),
        (["task=Table", "method=gd"], 10.0),
        (["task=Move", "method=gd", "method.lr_by_task.plab.other=3"], 3.0),
        (["task=Writer", "method=gd"], 100.0),
        (["task=Chopsticks", "method=adam_h"], 0.1),
        (["task=TripleMove"], 0.1),
        (["task=TripleMove", "protocol=release"], 0.01),
        (["task=TripleMove", "protocol=release", "method=gd"], 0.01),
        (["task=Chopsticks", "protocol=release", "method=gd"], 0.1),
        (["task=Chopsticks", "method.lr=0.3"], 0.3),
        (["task=Chopsticks", "method.lr_by_task.plab.Chopsticks=0.2"], 0.2),
    ],
)
def test_a_learning_rate_goes_by_numbers_and_task(overrides: list[str], lr: float):
    method = load_config(overrides).method
    assert method.lr == lr and method.lr_by_task == {}


@pytest.mark.parametrize(
    ("overrides", "limit"),
    [
        (["method=adam"], None),
        (["method=gd"], 0.03),
        (["method=gd", "protocol=release"], None),
        (["method=gd", "method.max_gradient_norm=null"], None),
        (["method=gd", "method.max_gradient_norm_by_numbers.plab=2"], 2.0),
    ],
)
def test_gd_has_a_limit_with_plabs_numbers(overrides: list[str], limit: float | None):
    method = load_config(overrides).method
    assert method.max_gradient_norm == limit and method.max_gradient_norm_by_numbers == {}


@pytest.mark.parametrize(
    ("overrides", "weight"),
    [
        (["task=Assembly"], 200.0),
        (["task=Move"], 1.0),
        (["task=Assembly", "method=gd"], 1.0),
        (["task=Assembly", "method=adam_h"], 1.0),
        (["task=Assembly", "method=solve"], 1.0),
        (["task=Assembly", "protocol=release"], 1.0),
        (["task=Assembly", "protocol.contact=soft"], 1.0),
        (["task=Assembly", "method.loss_weights.contact=2"], 2.0),
        (["task=Assembly", "method.contact_by_task.nearest.Assembly=3"], 3.0),
        (["task=Move", "+method.contact_by_task.nearest.Move=3"], 3.0),
    ],
)
def test_adam_has_a_contact_weight_by_task(overrides: list[str], weight: float):
    method = load_config(overrides).method
    assert method.loss_weights == {"density": 10.0, "sdf": 10.0, "contact": weight}
    assert getattr(method, "contact_by_task", {}) == {}


def test_load_config_leaves_a_surrounding_hydra_alone():
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        load_config(["seed=1"])
        assert compose("config", overrides=["seed=2"]).seed == 2


# ------------------------------------------------------------------------------ refusals

REFUSED = [
    (
        "task=Ropee",
        "task 'Ropee' does not exist; did you mean Rope? choose from: Assembly, Chopsticks, Move,",
    ),
    ("method=adm", "method 'adm' does not exist; did you mean adam? choose from: adam, adam_h, apg, cem"),
    ("sim=slow", "sim 'slow' does not exist; choose from: fast, reference"),
    ("method=", "method '' does not exist; choose from: adam, adam_h, apg, cem"),
    ("task=null", "name one task; choose from: Assembly, Chopsticks, Move,"),
    ("task=[Rope,Move]", "name one task; choose from: Assembly, Chopsticks, Move,"),
    ("+sim=reference", "write sim=reference"),
    (
        "tsk=Move",
        "unknown key 'tsk'; did you mean task? choose from: task, method, protocol, sim, targets",
    ),
    ("lr=0.1", "unknown key 'lr'; did you mean method.lr?"),
    (
        "sim.presicion=float64",
        "unknown key 'sim.presicion'; did you mean precision? choose from: precision, device",
    ),
    ("task.bodies.rop.particles=1", "unknown key 'task.bodies.rop'; did you mean rope?"),
    ("+sed=1", "unknown key 'sed'; did you mean seed?"),
    ("+method.foo=1", "unknown key 'method.foo'; choose from: name, family"),
    (
        "+task.bodies.rope.colour=red",
        "unknown key 'task.bodies.rope.colour'; choose from: shape, center, size",
    ),
    ("~seed", "keys cannot be removed"),
    ("seed", "cannot read 'seed': write key=value"),
    ("seed='", "cannot read"),
    ("seed=0,1", "'seed=0,1' gives several values: add -m"),
    ("seed=abc", "seed: Value 'abc' of type 'str' could not be converted to Integer"),
    ("seed=1.5", "seed: Value '1.5' of type 'float' could not be converted to Integer"),
    ("seed=null", "seed: field 'seed' is not Optional"),
    ("seed=-1", "seed must be at least 0, not -1"),
    ("seed=4294967296", "seed must be below 2^32"),
    ("force=maybe", "force: Value 'maybe' is not a valid bool"),
    ("results_dir=", "results_dir is empty"),
    ("variant=null", "variant: field 'variant' is not Optional"),
    ("variant=random7", "variant random7 of task Rope does not exist; did you mean random? choose from: 1,"),
    ("+task.variants.a/b=1", "cannot read"),
    ("seed_scene=3", "'seed_scene=3' has no effect without variant=random"),
    ("task.random.ranges.pillar.low=[0,0,0]", "has no effect without variant=random"),
    ("variant=0", "variant 0 of task Rope does not exist; choose from: 1, 2, 3, 4, 5"),
    ("variant=9", "variant 9 of task Rope does not exist; choose from: 1, 2, 3, 4, 5"),
    ("task.variants.1=7", "variant 1 of task Rope must be a part of the task's structure, or {}, not 7"),
    ("+task.variants.1.foo=1", "variant 1 of task Rope: unknown key 'task.foo'; choose from: name"),
    ("task.manipulators.pillar.position=[0,0,0]", "override task.variants.1.manipulators.pillar.position"),
    (
        "task.variants.1.manipulators.pillar.position=[0,0]",
        "pillar.position must be 3 finite numbers, not [0.0, 0.0]",
    ),
    ("task.manipulators.left.position=[0.2,-1,0.8]", "left.position: y = -1 is outside its bounds 0 .. 1"),
    ("task.manipulators.left.scale=[1,nan,1]", "left.scale must be 3 finite numbers"),
    ("task.bodies.rope.particles=0", "task.bodies.rope.particles must be at least 1, not 0"),
    ("task.youngs_modulus=0", "task.youngs_modulus must be positive and finite, not 0"),
    ("task.yield_stress=-1", "task.yield_stress must be at least 0, not -1"),
    ("task.floor_friction=nan", "task.floor_friction must be at least 0, not nan"),
    ("task.gravity=[0,0]", "task.gravity must be 3 finite numbers, not [0.0, 0.0]"),
    ("task.name=a/b", "task.name 'a/b' must be letters, digits, - and _"),
    ("task.target.recipe=rings", "task.target.recipe 'rings' does not exist; choose from: bodies, ring"),
    ("task.target.radius=wide", "task.target.radius: Value 'wide'"),
    ("method.contact=firm", "method.contact 'firm' does not exist; choose from: soft, hard"),
    ("method.optimizer=sgd", "method.optimizer 'sgd' does not exist; did you mean gd? choose from: adam, gd"),
    ("method.softness=0", "method.softness must be positive and finite, not 0"),
    ("method.loss_weights.sdf=-1", "method.loss_weights.sdf must be at least 0 and finite, not -1"),
    ("method.loss_weights={density: 0, sdf: 0, contact: 0}", "method.loss_weights are all 0"),
    ("method.lr=nan", "method.lr must be positive and finite, not nan"),
    ("method.lr=inf", "method.lr must be positive and finite, not inf"),
    ("method.betas=[0.9]", "method.betas must be 2 finite numbers, not [0.9]"),
    ("method.betas=[0.9,1]", "method.betas must be in [0, 1), not 1"),
    ("method.betas=0.9", "method.betas: Invalid value assigned"),
    ("method.momentum=1", "method.momentum must be in [0, 1), not 1"),
    ("method.eps=0", "method.eps must be positive"),
    ("method.iterations=0", "method.iterations must be at least 1, not 0"),
    ("method.action_init=2", "method.action_init must be in [0, 1], not 2"),
    ("experiment=yield_ablation", "write +experiment=yield_ablation"),
    (
        "+experiment=yield_ablatoin",
        "experiment 'yield_ablatoin' does not exist; did you mean yield_ablation? choose from: paper_",
    ),
    ("method.name=", "method.name '' must be"),
    ("sim.precision=float16", "sim.precision 'float16' does not exist; did you mean float64?"),
    ("sim.device=gpu", "sim.device 'gpu' does not exist; choose from: cpu, cuda"),
    ("sim.memory_mb=0", "sim.memory_mb must be positive"),
    ("sim.grid_size=4", "sim.grid_size must be at least 8, not 4"),
    ("sim.substeps=0", "sim.substeps must be at least 1, not 0"),
    ("sim.horizon=0", "sim.horizon must be at least 1, not 0"),
    ("sim.particles_scale=0", "sim.particles_scale must be positive"),
    ("sim.dt=-1", "sim.dt must be positive"),
]


@pytest.mark.parametrize(("override", "message"), REFUSED, ids=[override for override, _ in REFUSED])
def test_refused(override, message):
    with pytest.raises(ConfigError) as info:
        load_config([override])
    assert message in str(info.value)
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    ("method", "override", "message"),
    [
        (
            "sac",
            "profile=papr",
            "method.profile 'papr' does not exist; did you mean paper? choose from: paper,",
        ),
        ("sac", "algorithm=dqn", "method.algorithm 'dqn' does not exist; choose from: sac, td3, ppo"),
        ("sac", "num_envs=0", "method.num_envs must be at least 1, not 0"),
        ("sac", "episodes=0", "method.episodes must be at least 1, not 0"),
        ("sac", "gamma=0", "method.gamma must be in (0, 1], not 0"),
        ("sac", "hidden=[0]", "method.hidden must be at least 1, not 0"),
        ("sac", "tau=2", "method.tau must be in (0, 1], not 2"),
        ("sac", "torch_device=gpu", "method.torch_device 'gpu' does not exist; choose from: cpu, cuda"),
        ("sac", "gradient_steps=0", "method.gradient_steps must be at least 1, not 0"),
        ("sac", "buffer_size=0", "method.buffer_size must be at least 1, not 0"),
        ("sac", "epochs=3", "unknown key 'method.epochs'; choose from: name"),
        ("td3", "target_noise=-1", "method.target_noise must be at least 0 and finite, not -1"),
        ("td3", "policy_delay=0", "method.policy_delay must be at least 1, not 0"),
        ("ppo", "minibatches=1251", "method.minibatches must be at most steps_per_update / 2 = 1250"),
        ("ppo", "gae_lambda=1.1", "method.gae_lambda must be in [0, 1], not 1.1"),
        ("ppo", "value_clip_range=0", "method.value_clip_range must be positive and finite, not 0"),
        ("ppo", "policy_gain=0", "method.policy_gain must be positive and finite, not 0"),
        ("ppo", "statistics_episodes=0", "method.statistics_episodes must be at least 1, not 0"),
        ("apg", "hidden=[16,-1]", "method.hidden must be at least 1, not -1"),
        ("apg", "torch_threads=0", "method.torch_threads must be at least 1, not 0"),
    ],
)
def test_refused_of_a_method(method, override, message):
    with pytest.raises(ConfigError) as info:
        load_config([f"method={method}", f"method.{override}"])
    assert message in str(info.value)
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sim.dt=1e-3", "dt 0.001 is above the stability limit 0.000171"),
        ("task.poisson_ratio=0.5", "poisson_ratio 0.5 is outside [0, 0.5)"),
        ("task.bodies.rope.shape=cone", "shape 'cone' is not one of sphere, box, mesh"),
        ("task.bodies.rope.size=[0.6]", "a box needs 3 size(s), not 1"),
        ("task.bodies.rope.center=[0.5,0.5,0.99]", "outside the domain"),
        ("task.manipulators.left.shape=Ball", "shape 'Ball' is not one of Sphere, Capsule"),
        ("task.manipulators.left.rotation=[1,1,0,0]", "give a unit quaternion"),
        ("task.manipulators.left.friction=-1", "friction -1 must not be negative"),
    ],
)
def test_scenes_that_cannot_be_simulated(override, message):
    with pytest.raises(SceneError) as info:
        build_scene(load_config([override]))
    assert message in str(info.value)
