"""Composition of a run's configuration from files and overrides, validation, and the scene.

``conf/*.yaml`` has all default values; the dataclasses in this package define the keys. Hydra composes the
files, optionally with a user's folder, and the overrides. :func:`finish` merges the chosen variant over the
task and returns plain dataclasses, independent of Hydra and OmegaConf.
"""

from __future__ import annotations

import dataclasses
import functools
import pickle
from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import Override, OverrideType
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from plab.config import ranges
from plab.config.families import family
from plab.config.overrides import RANDOM, explained, parse, prepared, quoted, variant_changes
from plab.config.run import Config
from plab.config.suite import choices, plab_folder
from plab.errors import ConfigError, located, suggest
from plab.plugins import search_in
from plab.scenes import MATERIAL_KEYS, Scene, vector3
from plab.targets import check_target, load_release_target

GROUPS = ("task", "method", "protocol", "sim")
"""Sections of the configuration that select one file."""

EXPERIMENT = "experiment"
"""Group of files that preset any keys and sweeps over them; added by ``+experiment=``."""


@dataclasses.dataclass
class _Composed(Config):
    """A configuration as composed by Hydra, with an untyped method."""

    method: Any


ConfigStore.instance().store(name="plab_schema", node=_Composed)


TABLES = {"lr_by_task": "numbers", "contact_by_task": "contact", "max_gradient_norm_by_numbers": "numbers"}
"""Tables of a method, and the key of ``protocol`` that selects a row."""


def _by_task(table: str, default: Any = None, *, _parent_: DictConfig, _root_: DictConfig) -> Any:
    """Return the entry of a method's table for the protocol and the task, or for ``other``."""
    method = _parent_ if table in _parent_ else _root_.method
    row = method[table].get(_root_.protocol[TABLES[table]], default)
    return row.get(_root_.task.name, row.get("other", default)) if isinstance(row, DictConfig) else row


OmegaConf.register_new_resolver("by_task", _by_task, replace=True)


# ------------------------------------------------------------------------------------------------ composition


def load_config(
    overrides: Sequence[str] = (), config_dir: str | Path | None = None, *, alone: bool = False
) -> Config:
    """Compose a configuration.

    Args:
        overrides: As on the command line: ``["task=Move", "seed=3", "method.lr=0.05"]``.
        config_dir: Folder with the user's files, in subfolders named like the groups.
        alone: Whether the configuration is for a single run, so that overrides for another variant, task or
            profile are errors.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: If an override or a file is invalid.
    """
    words = prepared(overrides)
    check_overrides(words, config_dir)
    return finish(compose(words, config_dir), words, alone=alone)


def compose(words: Sequence[str], config_dir: str | Path | None = None) -> DictConfig:
    """Return Hydra's composition of prepared overrides, without its own section; raise ConfigError if an
    override or a file is invalid.

    Hydra takes a tenth of a second. Configurations that differ only in values are composed once, and the
    values are set afterwards, as Hydra does.
    """
    parsed = parse(words)
    values = [one for one in parsed if _sets_a_value(one)]
    files = [str(one.input_line) for one in parsed if one not in values]
    own = [] if config_dir is None else Path(config_dir).expanduser().glob("*/*.yaml")
    state = config_dir, *((path, path.stat().st_mtime_ns) for path in own)
    config: DictConfig = pickle.loads(_composed(tuple(files), *state))
    try:
        for override in values:
            OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
    except OmegaConfBaseException:
        # Hydra reports unknown keys and wrong types, and knows the user's groups.
        config = pickle.loads(_composed(tuple(words), *state))
    return config


@functools.lru_cache(maxsize=1024)
def _composed(words: tuple[str, ...], config_dir: str | Path | None, *_: tuple[Path, int]) -> bytes:
    """Return Hydra's composition without its own section, pickled; the state of the user's files, paths and
    times of modification, is part of the cache's key."""
    composed = compose_with_hydra(words, config_dir)
    with open_dict(composed):
        del composed["hydra"]
    return pickle.dumps(composed)


def compose_with_hydra(words: Sequence[str], config_dir: str | Path | None = None) -> DictConfig:
    """Return Hydra's composition of prepared overrides, including its own section; see :func:`compose`."""
    overrides = list(words)
    if config_dir is not None:
        folder = quoted(f"file://{Path(config_dir).expanduser().resolve()}")
        overrides.append(f"hydra.searchpath=[{folder}]")
    with explained():
        composed = hydra_app().compose_config(
            config_name="config",
            overrides=overrides,
            run_mode=RunMode.RUN,
            from_shell=False,
            with_log_configuration=False,
        )
    return composed


def hydra_app() -> Hydra:
    """Return a Hydra application for plab's files, independent of other applications."""
    version.setbase("1.3")
    return Hydra("plab", ConfigLoaderImpl(config_search_path=create_config_search_path(str(plab_folder()))))


def _sets_a_value(override: Override) -> bool:
    """Return whether an override sets one value, without sweep, file selection or prefix."""
    group = override.key_or_group in GROUPS or "/" in override.key_or_group or override.package is not None
    other = group or override.is_sweep_override() or override.is_hydra_override()
    return override.type is OverrideType.CHANGE and not other


def check_overrides(words: Sequence[str], config_dir: str | Path | None = None) -> None:
    """Raise ConfigError for file selections that Hydra would misinterpret, and for a folder of user files and
    modules, see :mod:`plab.plugins`, that cannot be used."""
    if config_dir is not None:
        folder = Path(config_dir).expanduser()
        if not str(config_dir).strip() or not folder.is_dir():
            raise ConfigError(f"config folder '{config_dir}' does not exist")
        for path in (path for group in (*GROUPS, EXPERIMENT) for path in (folder / group).glob("*.yaml")):
            # Hydra would ignore it.
            if path.stem in choices(path.parent.name):
                raise ConfigError(f"{path}: plab has a {path.parent.name} with this name: rename the file")
        search_in(folder)
    for override in parse(words):
        key, text = override.key_or_group, str(override.input_line)
        if key not in (*GROUPS, EXPERIMENT) or override.package is not None:
            continue
        if override.is_add() != (key == EXPERIMENT):
            raise ConfigError(f"'{text}': write {'+' * (key == EXPERIMENT)}{text.lstrip('+')}")
        if not isinstance(override.value(), str) and (key == EXPERIMENT or not override.is_sweep_override()):
            raise ConfigError(f"'{text}': choose one {key} from: {', '.join(choices(key, config_dir))}")


def finish(composed: DictConfig, words: Sequence[str] = (), *, alone: bool = True) -> Config:
    """Convert the result of :func:`compose` to a checked configuration, see :func:`load_config`.

    The chosen variant is merged over the task. The result contains only the chosen variant, because unused
    values are not part of a run's configuration.
    """
    with explained():
        composed.method = _typed_method(composed.method, "method")
        # Hydra closes all dictionaries, but a variant may add a body. Keys of dataclasses stay closed.
        OmegaConf.set_struct(composed, None)
        overrides = parse(words)
        _require_effect(composed, overrides, alone)
        _choose_profile(composed.method)
        for section in (composed.method, composed.method.get("planner", {})):
            if "lr_by_task" in section:
                _resolve(section, TABLES)
        if composed.protocol.numbers == "release":
            _refuse_undone(overrides, composed.task.release, "protocol.numbers=release", "task.release")
            composed.task.merge_with(composed.task.release)
        composed.task.release = {}
        _choose_variant(composed, overrides)
        made = cast(_Composed, OmegaConf.to_object(composed))
    made.check()
    cfg = Config(**vars(made))
    cfg.results_dir = str(Path(cfg.results_dir).expanduser())
    if cfg.targets.source is not None:
        cfg.targets.source = str(Path(cfg.targets.source).expanduser())
    cfg.task.pin_files()
    return cfg


def drawn_configs(cfg: Config, seeds: Iterable[int]) -> list[Config]:
    """Return copies of a configuration with random scenes (``variant=random``), one per ``seed_scene``; raise
    ConfigError if the task is not an unmodified task of the suite, or has no ``random`` section."""
    from plab.config.randomization import with_own_materials

    if cfg.task.name not in choices("task"):
        raise ConfigError(f"{cfg.task.name} is a task of your own: random scenes in a run need one of plab's")

    def drawing(variant: str, seed_scene: int | None) -> Config:
        seed = [] if seed_scene is None else [f"seed_scene={int(seed_scene)}"]
        one = load_config([f"task={cfg.task.name}", f"variant={variant}", *seed])
        return with_own_materials(replace(one, task=replace(one.task, randomize=cfg.task.randomize)))

    own = drawing(cfg.variant if cfg.seed_scene is None else RANDOM, cfg.seed_scene)
    if own.task != with_own_materials(cfg).task:
        raise ConfigError(
            f"random scenes need the task {cfg.task.name} of its file: remove the overrides that change the "
            "task, or the random scenes"
        )
    drawn = [drawing(RANDOM, seed) for seed in seeds]
    return [replace(cfg, task=one.task, variant=one.variant, seed_scene=one.seed_scene) for one in drawn]


# ------------------------------------------------------------------------------------------ scene and devices


def require_configs(cfgs: object) -> None:
    """Raise ConfigError unless ``cfgs`` is a sequence of at least one configuration."""
    if isinstance(cfgs, Config) or cfgs in ([], ()):
        raise ConfigError("pass a list of configurations, one per environment: [cfg]")
    if not isinstance(cfgs, Sequence) or not all(isinstance(cfg, Config) for cfg in cfgs):
        raise ConfigError("pass a configuration, such as plab.load_config(['task=Move', 'seed=3'])")


def build_scene(cfg: Config) -> Scene:
    """Build and validate the scene of a configuration.

    Raises:
        ConfigError: If ``cfg`` is not a configuration, or its task is that of another variant.
        plab.scenes.SceneError: If the scene cannot be simulated.
    """
    require_configs([cfg])
    task, protocol, sim = cfg.task, cfg.protocol, cfg.sim
    if cfg.variant not in task.variants:
        advice = suggest(cfg.variant, list(task.variants))
        raise ConfigError(f"variant {cfg.variant} of task {task.name} does not exist; {advice}")
    scene = Scene(
        bodies=task.build_bodies(sim.particles_scale),
        **task.build_tools(),
        **{key: getattr(task, key) for key in ("name", *MATERIAL_KEYS, "floor_friction")},
        **{key: getattr(sim, key) for key in ("grid_size", "dt", "substeps", "horizon")},
        gravity=vector3(task.gravity),
        particle_seed=cfg.seed_particles,
        sampling_convention=protocol.start,
        digits_convention=protocol.numbers,
        floor_stencil=protocol.floor,
    )
    scene.validate()
    return scene


def check_sources(cfg: Config) -> None:
    """Check scene, memory and target; raise ConfigError, SceneError or TargetError."""
    # Imported here: Taichi takes a second.
    from plab.sim.memory import require_memory

    scene, source = build_scene(cfg), cfg.targets.source
    require_memory([scene], cfg.sim.precision, cfg.sim.device)
    if source is None:
        check_target(scene, cfg.task.target)
    else:
        load_release_target(source, scene, cfg.variant)


def require_runnable(cfg: Config) -> None:
    """Raise ConfigError unless the device and the optional packages that a run needs are available."""
    # Imported here: Taichi takes a second.
    from plab.sim.runtime import cuda_devices

    if cfg.sim.device == "cuda" and not cuda_devices():
        raise ConfigError("sim.device=cuda: this computer has no usable CUDA device; choose sim.device=cpu")
    if cfg.logger != "none" and find_spec(cfg.logger) is None:
        raise ConfigError(f"logger={cfg.logger} needs a package: pip install 'plab[{cfg.logger}]'")


# ---------------------------------------------------------------------------------------------------- details


def _typed_method(method: DictConfig, path: str) -> DictConfig:
    """Convert a ``method`` section to its type."""
    if not isinstance(method, DictConfig) or "family" not in method:
        raise ConfigError(f"{path}.family is missing: set it to the name of a family, or to module:NAME")
    if isinstance(stages := method.get("stages"), DictConfig):
        for name in stages:
            stages[name] = _typed_method(stages[name], f"{path}.stages.{name!s}")
    if isinstance(planner := method.get("planner"), DictConfig):
        method.planner = _typed_method(planner, f"{path}.planner")
    kind: Any = family(str(method.family)).config_type(method.get("algorithm"))
    # Planners and gradient methods sample initial actions.
    if path.endswith(".planner") and "action_init" not in kind.__dataclass_fields__:
        raise ConfigError(f"{path}={method.name} cannot plan: choose cem, mppi, cmaes, multistart, adam, gd")
    # Below a root, so that error messages name the full key.
    root = OmegaConf.create({})
    OmegaConf.update(root, path, OmegaConf.structured(kind))
    OmegaConf.select(root, path).merge_with(method)
    return OmegaConf.select(root, path)


def _require_effect(composed: DictConfig, overrides: Sequence[Override], alone: bool) -> None:
    """Reject overrides of values that belong to another variant, profile, protocol or task."""
    task, method, variant, protocol = composed.task, composed.method, composed.variant, composed.protocol
    # By section: the related selection, and the entry in use, if any.
    used: dict[str, tuple[str, str | None]] = {}
    if alone:
        used["method.profiles."] = f"method.profile={method.get('profile')}", method.get("profile")
        for table, key in TABLES.items():
            chosen, tasks = protocol[key], method.get(table, {}).get(protocol[key])
            used[f"method.{table}."] = f"protocol.{key}={chosen}", chosen
            if isinstance(tasks, DictConfig):
                own = "other" if "other" in tasks and task.name not in tasks else task.name
                used[f"method.{table}.{chosen}."] = f"task={task.name}", own
    if alone or variant == RANDOM:
        # A random variant uses the variant with the values that are not sampled, if any.
        chosen = task.random.get("variant") if variant == RANDOM else variant
        used |= dict.fromkeys(("task.variants.", "task.release.variants."), (f"variant={variant}", chosen))
    if variant != RANDOM:
        used |= dict.fromkeys(("task.random.", "seed_scene."), (f"variant={variant}", None))
    if protocol.numbers != "release":
        used["task.release."] = f"protocol.numbers={protocol.numbers}", None
    if composed.targets.source is not None:
        used["task.target."] = "targets.source", None
    for override in overrides:
        key = f"{override.key_or_group}."
        for section, (choice, name) in used.items():
            if key.startswith(section) and key.removeprefix(section).partition(".")[0] != name:
                raise ConfigError(f"'{override.input_line}' has no effect with {choice}")


def _refuse_undone(overrides: Sequence[Override], changes: DictConfig, choice: str, place: str) -> None:
    """Reject overrides of task keys that ``changes`` overwrite."""
    for override in overrides:
        group, _, key = override.key_or_group.partition(".")
        if group == "task" and key and OmegaConf.select(changes, key) is not None:
            raise ConfigError(f"task.{key} is set by {choice}: override {place}.{key}")


def _choose_profile(method: DictConfig) -> None:
    """Resolve references to the selected profile, and remove the profiles."""
    if method.get("profile") is not None or method.get("profiles"):
        ranges.one_of("method.profile", str(method.profile), list(map(str, method.profiles)))
        _resolve(method, ["profiles"])


def _resolve(section: DictConfig, tables: Iterable[str]) -> None:
    """Resolve references to tables, and empty the tables."""
    OmegaConf.resolve(section)
    for table in tables:
        section[table] = {}


def _choose_variant(composed: DictConfig, overrides: Sequence[Override]) -> None:
    """Merge the selected variant, sampled if random, into the task, and remove the others."""
    task, name = composed.task, composed.variant
    if name == RANDOM and task.random:
        from plab.config.randomization import draw_variant

        changes, place = draw_variant(task, composed.seed_scene), "task.random"
        composed.variant = f"{RANDOM}{composed.seed_scene}"
    else:
        changes, place = variant_changes(task, name), f"task.variants.{name}"
        composed.seed_scene = None
    _refuse_undone(overrides, changes, f"variant={name}", place)
    with located(f"variant {composed.variant} of task {task.name}"), explained():
        task.merge_with(changes)
    task.variants, task.random = {composed.variant: changes}, {}
