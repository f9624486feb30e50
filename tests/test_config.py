"""Configuration: YAML against dataclasses, values by task and protocol, ranges, and the resulting scenes."""

from __future__ import annotations

import dataclasses
import functools
import json
from math import inf, nan
from typing import Any

import pytest
from hydra import compose, initialize_config_dir

from plab.config import Config, ConfigError, build_scene, choices, load_config, plab_folder
from plab.scenes import SceneError
from refusals import why

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

VARIANTS = [
    pytest.param(task, variant, marks=() if variant == 1 + number % 5 else pytest.mark.nightly)
    for number, task in enumerate(SUITE)
    for variant in range(1, 6)
]
"""Each task once; all variants nightly."""


# ------------------------------------------------------------------------------ YAML and dataclasses


@pytest.mark.parametrize("method", choices("method"))
def test_every_method_composes(method):
    cfg = load_config([f"method={method}"])
    assert isinstance(cfg, Config) and cfg.method.name == method


def test_methods_differ_only_where_their_files_say():
    adam, gd, adam_h = (
        dataclasses.asdict(load_config([f"method={m}"]).method) for m in ("adam", "gd", "adam_h")
    )
    assert gd == adam | {"name": "gd", "optimizer": "gd", "lr": 100.0, "max_gradient_norm": 0.03}
    assert adam_h == adam | {"name": "adam_h", "contact": "hard"}


# ------------------------------------------------------------------------------ scenes and variants


@pytest.mark.parametrize(("task", "variant"), VARIANTS)
def test_every_variant_is_a_valid_scene(task, variant):
    scene = build_scene(load_config([f"task={task}", f"variant={variant}"]))
    assert scene.name == task and scene.youngs_modulus == 5000
    assert scene.poisson_ratio == (0.05 if task == "Table" else 0.2)
    assert scene.gravity == (0, -150 if task == "Chopsticks" else -30, 0)
    assert (scene.grid_size, scene.dt, scene.substeps, scene.horizon) == (64, 1e-4, 19, 50)
    assert (scene.yield_stress, scene.particle_count, scene.action_dim) == SUITE[task]


def test_a_loaded_configuration_is_plain_and_holds_its_own_variant_only():
    cfg = load_config(["task=Move", "variant=3"])
    assert cfg.task.bodies["ball"].size == [0.10759] and list(cfg.task.variants) == ["3"]
    assert json.loads(json.dumps(dataclasses.asdict(cfg))) == dataclasses.asdict(cfg)
    cfg.variant = "4"
    with pytest.raises(ConfigError, match="variant 4 of task Move does not exist; choose from: 3"):
        build_scene(cfg)


def test_a_variant_may_change_anything_and_add_bodies():
    box = "{shape: box, center: [0.5, 0.3, 0.2], size: [0.1, 0.1, 0.1], particles: 10}"
    changes = f"bodies={{second: {box}}}", "yield_stress=7", "bodies.rope.particles=20"
    scene = build_scene(load_config([f"+task.variants.1.{change}" for change in changes]))
    assert scene.yield_stress == 7 and [body.particles for body in scene.bodies] == [20, 10]


def test_a_tilde_is_the_home(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    cfg = load_config(["results_dir=~/my results", "targets.source=~/files"])
    assert (cfg.results_dir, cfg.targets.source) == (f"{tmp_path}/my results", f"{tmp_path}/files")


def test_the_variant_is_a_string_and_seed_scene_is_left_out():
    cfg = load_config(["variant=3"])
    assert (cfg.variant, cfg.seed_scene, cfg.task.random) == ("3", None, {})
    assert cfg == load_config(["variant='3'"])


LEARNING_RATES = {
    "task=Move": 0.1,
    "task=Chopsticks": 0.01,
    "task=Chopsticks method=gd": 10.0,
    "task=Writer method=gd": 100.0,
    "task=Move method=gd method.lr_by_task.plab.other=3": 3.0,
    "task=Chopsticks method=adam_h": 0.1,
    "task=TripleMove": 0.1,
    "task=TripleMove protocol=release": 0.01,
    "task=Chopsticks protocol=release method=gd": 0.1,
    "task=Chopsticks method.lr=0.3": 0.3,
    "task=Chopsticks method.lr_by_task.plab.Chopsticks=0.2": 0.2,
}

LIMITS = {
    "method=adam": None,
    "method=gd": 0.03,
    "method=gd protocol=release": None,
    "method=gd method.max_gradient_norm_by_numbers.plab=2": 2.0,
}

CONTACT_WEIGHTS = {
    "task=Assembly": 200.0,
    "task=Move": 1.0,
    "task=Assembly method=gd": 1.0,
    "task=Assembly protocol=release": 1.0,
    "task=Assembly protocol.contact=soft": 1.0,
    "task=Assembly method.loss_weights.contact=2": 2.0,
    "task=Assembly method.contact_by_task.nearest.Assembly=3": 3.0,
    "task=Move +method.contact_by_task.nearest.Move=3": 3.0,
}


def test_values_by_task_and_protocol():
    for given, lr in LEARNING_RATES.items():
        method = load_config(given.split()).method
        assert (method.lr, method.lr_by_task) == (lr, {}), given
    for given, limit in LIMITS.items():
        method = load_config(given.split()).method
        assert (method.max_gradient_norm, method.max_gradient_norm_by_numbers) == (limit, {}), given
    for given, weight in CONTACT_WEIGHTS.items():
        method = load_config(given.split()).method
        assert method.loss_weights == {"density": 10.0, "sdf": 10.0, "contact": weight}, given
        assert getattr(method, "contact_by_task", {}) == {}


def test_load_config_leaves_a_surrounding_hydra_alone():
    with initialize_config_dir(str(plab_folder()), version_base="1.3"):
        load_config(["seed=1"])
        assert compose("config", overrides=["seed=2"]).seed == 2


# ------------------------------------------------------------------------------ ranges

RANGES: dict[str, tuple[list[Any], list[Any], str]] = {
    "at least 1": (
        [0, -1],
        [1],
        """sim.substeps sim.horizon adam.iterations apg.iterations sac.episodes sac.evaluate_every
        sac.num_envs sac.batch_size td3.policy_delay pods.num_envs pods.updates pods.epochs pods.batch_size
        shac.num_envs shac.window shac.value_epochs shac.minibatches ppo.minibatches ppo.epochs
        ppo.statistics_episodes cem.iterations cem.knots multistart.updates multistart.replace_every
        bc.batch_size body.particles .observe_particles""",
    ),
    "positive": (
        [0.0, -1.0, nan, inf],
        [1e-9],
        """sim.memory_mb sim.dt sim.particles_scale adam.softness adam.lr adam.eps adam.max_gradient_norm
        apg.lr sac.lr pods.action_lr shac.value_lr shac.noise shac.max_gradient_norm ppo.clip_range
        ppo.value_clip_range ppo.max_gradient_norm ppo.adam_eps ppo.policy_gain ppo.value_gain cem.spread
        mppi.temperature multistart.eps multistart.softness_end body.youngs_modulus left.gap
        left.minimal_gap task.youngs_modulus""",
    ),
    "at least 0": (
        [-1e-9, nan],
        [0.0, inf],
        "sac.learning_starts pods.scenes task.yield_stress body.yield_stress task.floor_friction",
    ),
    "finite": (
        [-1e-9, nan, inf],
        [0.0],
        "td3.exploration_noise td3.target_noise td3.target_noise_clip pods.observation_noise pods.shift "
        "ppo.value_coefficient ppo.entropy_coefficient cem.least_spread .checkpoint_seconds",
    ),
    "below 1": ([-1e-9, 1.0, nan], [0.0, 0.99], "adam.momentum cem.smoothing"),
    "above 0": ([0.0, 1.01, nan], [1e-9, 1.0], "sac.gamma sac.tau shac.gamma shac.tau"),
    "unit": (
        [-1e-9, 1.01, nan],
        [0.0, 1.0],
        """adam.action_init shac.td_lambda ppo.gae_lambda cem.action_init cem.contact_starts mppi.decay
        multistart.fresh""",
    ),
    "seeds": ([-1, 2**32], [0, 2**32 - 1], ".seed .seed_particles"),
    "threads": ([0], [1, 256], "apg.torch_threads sac.torch_threads"),
    "widths": ([[0], [16, -1]], [[1], [16, 16]], "apg.hidden sac.hidden"),
    "decays": (
        [[0.9], [0.9, 1.0], [-0.1, 0.5], [nan, 0.9], [0.9] * 3],
        [[0.0, 0.99]],
        "adam.betas multistart.betas",
    ),
    "points": (
        [[0.5, 0.5], [nan, 0.5, 0.5], [inf, 0.5, 0.5]],
        [[0.5] * 3],
        "body.center left.position task.gravity",
    ),
    "rotations": ([[1, 0, 0], [nan, 0, 0, 0]], [[1, 0, 0, 0]], "left.rotation"),
    "names": (["", "a/b", "a b", ".."], ["a-b_3"], "adam.name task.name protocol.name"),
    "devices": (["", "gpu", "CUDA"], ["cpu", "cuda"], "sim.device sac.torch_device"),
    "conventions": (["", "paper"], ["plab", "release"], "protocol.start protocol.numbers protocol.floor"),
    "sim.precision": (["", "float16"], ["float32", "float64"], "sim.precision"),
    "sim.grid_size": ([0, 7], [8], "sim.grid_size"),
    "protocol.score": (["first"], ["best", "last"], "protocol.score"),
    "method.contact": (["", "firm"], ["soft", "hard"], "adam.contact"),
    "method.optimizer": (["", "sgd"], ["adam", "gd"], "adam.optimizer"),
    "method.algorithm": (["dqn"], ["sac", "ppo"], "sac.algorithm"),
    "method.curve": (["spline"], ["constant", "linear"], "cem.curve"),
    "method.objective": (["reward"], ["loss", "final", "score"], "cem.objective"),
    "method.population": ([3], [4], "mppi.population"),
    "method.elites": ([1], [2, 65], "cem.elites"),
    "method.lrs": ([[], [0.1, 0.0]], [[0.1]], "multistart.lrs"),
    "method.buffer_size": ([0], [1], "sac.buffer_size"),
    "method.gradient_steps": ([0, -2], [-1, 1], "sac.gradient_steps"),
    "method.steps_per_update": ([1], [], "ppo.steps_per_update"),
    "method.minibatches": ([1251], [1250], "ppo.minibatches"),
    "method.loss_weights": (
        [{"density": 1.0, "contact": wrong} for wrong in (-1.0, nan, inf)]
        + [{"density": 0.0, "contact": 0.0}],
        [{"sdf": 0.0, "contact": 1.0}],
        "adam.loss_weights",
    ),
    "logger": (["csv"], ["none", "wandb"], ".logger"),
    "results_dir": (["", "  "], ["a"], ".results_dir"),
}
"""Refused values, accepted values, and the keys of a range. A key's section is a method's name, or ``body``
and ``left`` of the task, or nothing for the root."""


@functools.cache
def section(name: str) -> tuple[Any, tuple[str, ...]]:
    """Section of the configuration, and the arguments of its ``check``."""
    cfg = load_config([f"method={name}"] if name in choices("method") else [])
    parts = {"": (cfg, ()), "body": (cfg.task.bodies["rope"], ("task.bodies.rope",))}
    parts["left"] = cfg.task.manipulators["left"], ("task.manipulators.left",)
    if name in parts:
        return parts[name]
    return (getattr(cfg, name), (name,)) if hasattr(cfg, name) else (cfg.method, ("method",))


@pytest.mark.parametrize("kind", RANGES)
def test_ranges(kind):
    refused, accepted, keys = RANGES[kind]
    for key in keys.split():
        name, _, field = key.partition(".")
        holder, path = section(name)
        for value in accepted:
            dataclasses.replace(holder, **{field: value}).check(*path)
        for value in refused:
            message = why(ConfigError, dataclasses.replace(holder, **{field: value}).check, *path)
            assert ".".join([*path, field]) in message, (key, value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sim.dt=1e-3", "dt 0.001 is above the stability limit 0.000171"),
        ("task.poisson_ratio=0.5", "poisson_ratio"),
        ("task.gravity=[0,-1e9,0]", "gravity"),
        ("task.bodies.rope.shape=cone", "cone"),
        ("task.bodies.rope.shape=mesh", "task.bodies.rope"),
        ("task.bodies.rope.size=[0.6]", "box needs 3"),
        ("task.bodies.rope.center=[0.5,0.5,0.99]", "outside the domain"),
        ("task.manipulators.left.shape=Ball", "Ball"),
        ("task.manipulators.left.size=[0.1,0.1]", "size"),
        ("task.manipulators.left.scale=[0.01]", "scale"),
        ("task.manipulators.left.rotation=[1,1,0,0]", "quaternion"),
        ("task.manipulators.left.friction=-1", "friction -1"),
        ("task.manipulators.left.position=[0.5,1.5,0.5]", "position"),
        ("task=Chopsticks task.manipulators.chopsticks.gap=0.05", "minimal_gap"),
    ],
)
def test_scenes_that_cannot_be_simulated(override, message):
    assert message in why((ConfigError, SceneError), lambda: build_scene(load_config(override.split())))
