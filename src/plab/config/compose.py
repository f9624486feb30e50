"""The configuration of a run: composed from files and overrides, checked, and turned into a scene.

``conf/*.yaml`` holds every number, the dataclasses beside this module say which keys there are. Hydra
composes the files, perhaps with a folder of the user's, and the overrides; :func:`finish` merges the chosen
variant over the task and returns plain dataclasses, so that nothing that works with them knows Hydra or
OmegaConf.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import OverrideType
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.config.composer import GROUPS, Composer
from plab.config.errors import COMPOSE_ERRORS, explain
from plab.config.run import Config
from plab.config.suite import conf_folder
from plab.config.variants import RANDOM, draw_variant, merge_variant, undone_key, variant_changes
from plab.config.words import parse, quote_folders, require_few, shortened, unusable, word_list
from plab.errors import ConfigError, pick
from plab.families import family, schemas
from plab.plugins import search_in
from plab.scenes import Scene, vector3

__all__ = [
    "EXPERIMENT",
    "GROUPS",
    "build_scene",
    "check_overrides",
    "choices",
    "drawn_configs",
    "finish",
    "load_config",
]

EXPERIMENT = "experiment"
"""Group of files that preset any keys and sweeps over them; added by ``+experiment=``."""


@dataclasses.dataclass
class _Composed(Config):
    """A configuration as Hydra composes it: of which type the method is, its YAML says."""

    method: Any


ConfigStore.instance().store(name="plab_schema", node=_Composed)
# A group of its own, so that `method=` offers real methods only.
for _name, _schema in schemas():
    ConfigStore.instance().store(group="schema/method", name=_name, node=_schema)


# ------------------------------------------------------------------------------------------------ composition


def choices(group: str, config_dir: str | Path | None = None) -> dict[str, Path]:
    """Return what a group offers.

    Args:
        group: ``task``, ``method``, ``protocol``, ``sim`` or ``experiment``.
        config_dir: Folder with files of the user's own, in subfolders named like the groups.

    Returns:
        Name to file, sorted by name.
    """
    folders = [conf_folder(), *([] if config_dir is None else [Path(config_dir)])]
    files = [path for folder in folders for path in (folder / group).glob("*.yaml")]
    return {path.stem: path for path in sorted(files, key=lambda path: path.stem)}


def _check_config_dir(config_dir: str | Path) -> None:
    """Raise ConfigError for a missing folder of the user's, a file in it that is no text, and one with a name
    of plab's own, which Hydra would ignore."""
    if not isinstance(config_dir, str | Path):
        raise ConfigError(f"a config folder is named by a text or a path, not {config_dir!r}")
    if not str(config_dir).strip():
        raise ConfigError("the config folder's name is empty: give one, or . for this one")
    if not Path(config_dir).is_dir():
        raise ConfigError(f"config folder '{config_dir}' does not exist")
    for group in (*GROUPS, EXPERIMENT):
        for path in (Path(config_dir) / group).glob("*.yaml"):
            if path.stem in choices(group):
                raise ConfigError(f"{path}: plab has a {group} of this name, give the file another one")
            try:
                path.read_text(encoding="utf-8")
            except (OSError, UnicodeDecodeError):
                raise ConfigError(f"{path}: cannot be read as a text in UTF-8") from None


def load_config(overrides: Sequence[str] = (), config_dir: str | Path | None = None) -> Config:
    """Compose a configuration, for notebooks and tests.

    Args:
        overrides: As on the command line: ``["task=Move", "seed=3", "method.lr=0.05"]``.
        config_dir: Folder with files of the user's own, in subfolders named like the groups.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: If an override or a file does not fit.
    """
    overrides = quote_folders(word_list(overrides))
    # Several configurations may share a list of overrides.
    return finish(_composed(overrides, config_dir), overrides, alone=False)


def _composed(overrides: Sequence[str], config_dir: str | Path | None) -> DictConfig:
    """Return what Hydra makes of overrides, as :func:`load_config` takes them."""
    try:
        check_overrides(overrides, config_dir)
        if config_dir is None:
            return _OWN(parse(overrides))
        quoted = str(Path(config_dir).resolve()).replace("'", "\\'")
        return _by_hydra([*overrides, f"hydra.searchpath=['file://{quoted}']"])
    except COMPOSE_ERRORS as error:
        raise ConfigError(explain(error)) from None
    except ConfigError:
        raise
    except Exception as error:
        if (reason := unusable(error, overrides)) is None:
            raise
        raise ConfigError(reason) from error


def _by_hydra(overrides: list[str]) -> DictConfig:
    """Compose within a Hydra application, too, and leave it as it was."""
    surrounding = GlobalHydra.instance().hydra
    try:
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(conf_folder()), version_base="1.3"):
            return compose("config", overrides=overrides)
    finally:
        GlobalHydra.instance().hydra = surrounding


_OWN = Composer(_by_hydra)
"""Composes of plab's own files, which do not change."""


def drawn_configs(cfg: Config, seeds: Iterable[int]) -> list[Config]:
    """Return configurations that differ from one in their scenes, which are drawn: ``variant=random``.

    Args:
        cfg: The configuration.
        seeds: A ``seed_scene`` for each.

    Raises:
        ConfigError: If the task is not one of the suite as it stands in its file, or has nothing to draw.
    """
    name, own = cfg.task.name, [f"variant={cfg.variant}"]
    if cfg.seed_scene is not None:
        own = ["variant=random", f"seed_scene={cfg.seed_scene}"]
    if load_config([f"task={name}", *own]).task != cfg.task:
        raise ConfigError(
            f"scenes of task {name} are drawn as its file has it: leave out what changes the task, or draw "
            "none"
        )
    drawn = [load_config([f"task={name}", "variant=random", f"seed_scene={int(seed)}"]) for seed in seeds]
    return [replace(cfg, task=one.task, variant=one.variant, seed_scene=one.seed_scene) for one in drawn]


def check_overrides(overrides: Sequence[str], config_dir: str | Path | None = None) -> None:
    """Refuse what Hydra takes but what makes no sense here, before it composes anything.

    Args:
        overrides: As on the command line.
        config_dir: Folder with files of the user's own, in subfolders named like the groups; modules that
            they name are found there from now on, see :mod:`plab.plugins`.

    Raises:
        ConfigError: If a key is to be removed, a group is not given exactly one choice, or the folder does
            not do.
        hydra.errors.HydraException: If an override cannot be parsed.
    """
    if config_dir is not None:
        _check_config_dir(config_dir)
        search_in(config_dir)
    parsed = parse(overrides)
    require_few(parsed)
    for override in parsed:
        key, text = override.key_or_group, str(override.input_line)
        if not key:
            raise ConfigError(f"cannot read '{text}': write key=value")
        if override.is_hydra_override():
            if (
                key.startswith("hydra/")
                and not isinstance(override.value(), str)
                and not override.is_delete()
            ):
                raise ConfigError(f"'{text}': name one, such as hydra/launcher=batch_joblib")
            continue
        if override.is_delete():
            raise ConfigError(f"'{text}': keys cannot be removed, only set")
        changes = override.type is OverrideType.CHANGE and not key.startswith("task.variants.")
        if changes and override.value() == {}:
            raise ConfigError(f"'{text}' has no effect: sections are changed key by key")
        if key == EXPERIMENT and not override.is_add():
            raise ConfigError(f"'{text}': write +{text.lstrip('+')}")
        if key == EXPERIMENT and not isinstance(override.value(), str):
            names = ", ".join(choices(key, config_dir))
            raise ConfigError(f"'{text}': name one experiment, itself a sweep; choose from: {names}")
        if key in GROUPS and override.package is None:
            if override.is_add() or override.is_force_add():
                raise ConfigError(f"'{text}': write {text.lstrip('+')}")
            if not override.is_sweep_override() and not isinstance(override.value(), str):
                names = ", ".join(choices(key, config_dir))
                raise ConfigError(f"'{text}': name one {key}; choose from: {names}")


def finish(composed: DictConfig, overrides: Sequence[str] = (), *, alone: bool = True) -> Config:
    """Turn what Hydra composed into a checked configuration.

    The chosen variant is merged over the task. The result keeps no other variant: what a run does not use is
    no part of its configuration.

    Args:
        composed: The composed configuration, without Hydra's own section.
        overrides: The command line's overrides; one that has no effect is an error.
        alone: Whether there is no other run, on which an override about another variant, task or profile
            could have its effect.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: If a value is missing, of the wrong type or out of range.
    """
    try:
        composed.method = _typed_method(composed.method)
        _reject_unknown(composed, "")
        # Hydra closes every dictionary; a variant may add a body. Keys of dataclasses stay closed.
        OmegaConf.set_struct(composed, None)
        _require_tables(composed.method)
        _require_effect(composed, overrides, alone)
        _choose_profile(composed.method)
        _choose_by_task(composed.method)
        _choose_numbers(composed, overrides)
        _choose_variant(composed, overrides)
        merge_variant(composed.task, composed.variant)
        parts = vars(OmegaConf.to_object(composed))
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error)) from None
    cfg = Config(**parts)
    cfg.check()
    cfg.task.pin_files()
    return cfg


def build_scene(cfg: Config) -> Scene:
    """Build the scene of a configuration.

    Args:
        cfg: A configuration.

    Returns:
        The validated scene.

    Raises:
        ConfigError: If the task is another variant's.
        plab.scenes.SceneError: If the scene cannot be simulated.
    """
    task, protocol, sim = cfg.task, cfg.protocol, cfg.sim
    if cfg.variant not in task.variants:
        advice = pick(cfg.variant, list(task.variants))
        raise ConfigError(f"variant {cfg.variant} of task {task.name} does not exist; {advice}")
    most = max((body.particles for body in task.bodies.values()), default=1)
    if most * sim.particles_scale < 0.5:
        least = f"use {0.5 / most:.2g} or more"
        raise ConfigError(f"sim.particles_scale={sim.particles_scale:g} leaves no particle: {least}")
    scene = Scene(
        name=task.name,
        bodies=task.build_bodies(sim.particles_scale),
        manipulators=tuple(manipulator.build() for manipulator in task.manipulators.values()),
        youngs_modulus=task.youngs_modulus,
        poisson_ratio=task.poisson_ratio,
        yield_stress=task.yield_stress,
        floor_friction=task.floor_friction,
        gravity=vector3(task.gravity),
        grid_size=sim.grid_size,
        dt=sim.dt,
        substeps=sim.substeps,
        horizon=sim.horizon,
        particle_seed=cfg.seed_particles,
        sampling_convention=protocol.start,
        digits_convention=protocol.numbers,
        floor_stencil=protocol.floor,
    )
    scene.validate()
    return scene


# ---------------------------------------------------------------------------------------------------- details


def _typed_method(method: DictConfig) -> DictConfig:
    """Return the section ``method`` with the types of its family, unless its YAML has chosen them.
    ConfigError if there is no such family, or the section is of another one's type; an
    OmegaConfBaseException if a key or a value does not fit."""
    if not isinstance(method, DictConfig) or "family" not in method:
        raise ConfigError("method.family has no value: name the family, or its module:NAME")
    record, rule = family(str(method.family)), method.get("algorithm")
    wanted, chosen = record.config_type(rule), OmegaConf.get_type(method)
    if not dataclasses.is_dataclass(chosen):
        # Below a root, so that what is wrong is named method.<key>.
        root = OmegaConf.create({"method": OmegaConf.structured(wanted)})
        root.merge_with({"method": method})
        return root.method
    if not issubclass(cast(type, chosen), wanted):
        has, needs = cast(type, chosen).__name__, wanted.__name__
        raise ConfigError(f"method has the keys of {has}: with its family or algorithm go those of {needs}")
    return method


_BY_TASK = {"lr_by_task": "numbers", "contact_by_task": "contact"}
"""Tables of a method that hold values by a choice of the protocol, and task."""


def _require_tables(method: DictConfig) -> None:
    """Refuse a value where those of the tasks belong."""
    for section in _BY_TASK:
        for choice, tasks in method.get(section, {}).items():
            if not isinstance(tasks, DictConfig):
                raise ConfigError(f"method.{section}.{choice} must be a table of tasks, not {tasks}")


def _require_effect(composed: DictConfig, overrides: Sequence[str], alone: bool) -> None:
    """Refuse overrides of what goes with another variant, profile or task than the chosen ones."""
    task, method, variant = composed.task, composed.method, composed.variant
    used: dict[str, tuple[str, str | None]] = {}
    if alone:
        used["method.profiles."] = f"method.profile={method.get('profile')}", method.get("profile")
        for section, key in _BY_TASK.items():
            chosen = composed.protocol[key]
            used[f"method.{section}."] = f"protocol.{key}={chosen}", chosen
            tasks = method.get(section, {}).get(chosen, {})
            used[f"method.{section}.{chosen}."] = (
                f"task={task.name}",
                "other" if "other" in tasks and task.name not in tasks else task.name,
            )
        numbers = composed.protocol.numbers
        used["method.max_gradient_norm_by_numbers."] = f"protocol.numbers={numbers}", numbers
    if alone or variant == RANDOM:
        # Of the variants a random one uses that which gives what is not drawn, if any.
        chosen = task.random.get("variant") if variant == RANDOM else variant
        used |= dict.fromkeys(("task.variants.", "task.release.variants."), (f"variant={variant}", chosen))
    for override in parse(overrides):
        for section, (choice, name) in used.items():
            key = override.key_or_group
            if key.startswith(section) and key.removeprefix(section).partition(".")[0] != name:
                raise ConfigError(f"'{shortened(str(override.input_line))}' has no effect with {choice}")
        if composed.targets.source is not None and f"{override.key_or_group}.".startswith("task.target."):
            line = shortened(str(override.input_line))
            raise ConfigError(f"'{line}' has no effect with targets.source: leave one of them out")


def _choose_profile(method: DictConfig) -> None:
    """Put the chosen profile's values where they are referred to, and forget the profiles."""
    if "profiles" not in method or (method.profile is None and not method.profiles):
        return
    if method.profile not in method.profiles:
        chosen, names = str(method.profile), [str(name) for name in method.profiles]
        raise ConfigError(f"method.profile '{chosen}' does not exist; {pick(chosen, names)}")
    _resolve(method, ["profiles"])


def _choose_by_task(method: DictConfig) -> None:
    """Put learning rate, contact weight and limit of the norm where they are referred to, and forget those of
    other tasks and numbers."""
    if "lr_by_task" in method:
        _resolve(method, [*_BY_TASK, "max_gradient_norm_by_numbers"])


def _resolve(section: DictConfig, tables: Sequence[str]) -> None:
    """Put values where they are referred to, except in tables, which are empty afterwards."""
    for key, node in section.items_ex(resolve=False):
        if OmegaConf.is_interpolation(section, str(key)):
            section[key] = section[key]
        elif key not in tables and OmegaConf.is_config(node):
            OmegaConf.resolve(node)
    for table in tables:
        section[table] = {}


def _choose_numbers(composed: DictConfig, overrides: Sequence[str]) -> None:
    """Put the release's numbers into the task if they are asked for, and forget them otherwise."""
    changes = composed.task.release
    if composed.protocol.numbers == "release":
        if key := undone_key(changes, overrides):
            raise ConfigError(f"task.{key} is set by protocol.numbers=release: override task.release.{key}")
        composed.task.merge_with(changes)
    elif unused := [o for o in overrides if o.lstrip("+").startswith("task.release.")]:
        raise ConfigError(f"'{unused[0]}' has no effect without protocol.numbers=release")
    composed.task.release = {}


def _choose_variant(composed: DictConfig, overrides: Sequence[str]) -> None:
    """Draw the variant if it is to be random, and refuse overrides that have no effect with this one."""
    task, name = composed.task, composed.variant
    if name == RANDOM:
        drawn = draw_variant(task, composed.seed_scene)
        if key := undone_key(drawn, overrides):
            raise ConfigError(f"task.{key} is set by variant=random: override what task.random says")
        composed.variant = f"{RANDOM}{composed.seed_scene}"
        task.variants = {composed.variant: drawn}
        return
    if key := undone_key(variant_changes(task, name), overrides):
        raise ConfigError(f"task.{key} is set by variant {name}: override task.variants.{name}.{key}")
    for override in parse(overrides):
        if override.key_or_group == "seed_scene" or f"{override.key_or_group}.".startswith("task.random."):
            raise ConfigError(f"'{override.input_line}' has no effect without variant=random")
    composed.seed_scene = None


def _reject_unknown(node: Any, path: str) -> None:
    """Refuse keys that no dataclass names; Hydra lets ``+key=value`` add them."""
    if not isinstance(node, DictConfig):
        return
    kind = OmegaConf.get_type(node)
    known = _field_names(kind) if dataclasses.is_dataclass(kind) else None
    for key, below in ((str(key), below) for key, below in node.items_ex(resolve=False)):
        if known is not None and key not in known:
            raise ConfigError(f"unknown key '{path}{key}'; {pick(key, known)}")
        if isinstance(below, DictConfig) and not (below._is_missing() or below._is_interpolation()):
            _reject_unknown(below, f"{path}{key}.")


def _field_names(kind: type) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]
