"""Selection of finished runs that can be averaged because they differ only in seed and variant."""

from __future__ import annotations

import functools
import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from plab.config.selection import OBSERVATION_KEYS, Selection, leaves, lookup, one_protocol
from plab.config.suite import PAPER_SEEDS, SUITE_VARIANTS, choices, shipped_file, suite_tasks
from plab.errors import ArgumentError
from plab.report.methods import method, ordered, part
from plab.results import Row, config_dict, rows
from plab.results.run_file import NAMES
from plab.results.run_table import Source, sources_of

SCENE = ("task.bodies", "task.manipulators", "task.target")
"""Sections of a task that are compared with those of plab's files."""

KEYS = ("method.family", "method.iterations", "method.episodes", "sim.horizon")
"""Configuration keys that are columns of the table of runs."""

_IGNORED_KEYS = (
    *("seed", "results_dir", "force", "progress", "logger", "checkpoint_seconds", "protocol.name"),
    *("sim.device", "sim.memory_mb", "sim.deterministic", "method.torch_device", "method.torch_threads"),
    *("method.lr_by_task", "method.contact_by_task", "method.max_gradient_norm_by_numbers"),
    # Takes effect through method.loss_terms.contact.
    "protocol.contact",
    "task.release",
)
"""Keys that may differ between averaged runs."""


@dataclass(frozen=True)
class Runs:
    """Finished and requested runs.

    Attributes:
        table: Table of :func:`plab.results.load`, one row per run.
        tasks: Requested tasks.
        variants: Requested variants.
        methods: Requested methods, in the order of tables.
        seeds: Requested seeds.
        unusual: Settings that differ from plab's, as text, with methods if only some runs have them.
        protocol: Name of the runs' protocol.
        left_out: Notes on runs missing from ``table``, with reasons.
        configs: Configurations of the runs, in the order of ``table``.
    """

    table: pd.DataFrame
    tasks: list[str]
    variants: list[str]
    methods: list[str]
    seeds: list[str]
    unusual: list[str]
    protocol: str
    left_out: list[str]
    configs: list[dict[str, Any]]

    @property
    def digest(self) -> str:
        """SHA-256, in hex, of configurations, evaluations and times, independent of file locations."""
        records = self.table.drop(columns="path").to_dict("records")
        lines = sorted(
            json.dumps({name: value for name, value in row.items() if value == value}, sort_keys=True)
            for row in records
        )
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()

    @property
    def expected(self) -> int:
        """Number of requested runs of all tasks, variants and seeds, for methods that have runs."""
        present = set(self.table["method"]) & set(self.methods)
        return len(self.tasks) * len(self.variants) * len(self.seeds) * len(present)


def collect(source: Source, chosen: Selection, split: str = "") -> Runs:
    """Find the runs for tables and curves.

    Args:
        source: Folder of results, archive, or several of them.
        chosen: Selection of runs; defaults: the suite's tasks, or those of the results if it has none of
            them; the suite's variants, or those of the results for tasks that are not plab's; the methods and
            seeds of the paper and of the results.
        split: Setting whose values are treated as separate methods: a dotted key, ``folder`` or ``seed``;
            empty: none.

    Raises:
        plab.errors.ArgumentError: If runs to be averaged differ in their settings, or have the same seed; if
            there are runs of several protocols, or no runs that differ in ``split``.
        plab.config.ConfigError: If the selection cannot match any run.
        plab.results.ResultsError: If ``source`` does not exist, or none of its files or archives can be read.
    """
    found, unreadable = rows(source, chosen)
    suite, own = suite_tasks(), sorted({row.values["task"] for row in found})
    tasks = chosen.choices.get("task", suite if not own or set(own) & set(suite) else own)
    variants = sorted({str(row.values["variant"]) for row in found if row.values["task"] in tasks})
    if not variants or set(tasks) & set(choices("task")):
        variants = list(SUITE_VARIANTS)
    free = {
        "task": tasks,
        "variant": variants,
        "method": ordered(row.values["method"] for row in found),
        "seed": sorted({str(row.values["seed"]) for row in found} | set(PAPER_SEEDS), key=int),
    }
    asked = {name: chosen.choices.get(name, free[name]) for name in NAMES}
    inside = [row for row in found if all(str(row.values[name]) in asked[name] for name in NAMES)]
    complete = [row for row in inside if row.values["status"] == "finished"]
    ended = [row for row in found if row.values["status"] == "finished"]
    others = {name: sorted({str(row.values[name]) for row in ended} - set(asked[name])) for name in NAMES}
    advice = " ".join(f"{name}={','.join(texts[:9])}" for name, texts in others.items() if texts)
    methods, seeds = asked["method"], asked["seed"]
    if split:
        complete, new = _split(complete, split, sources_of(source))
        names = {whole: [name for (of, _), name in new.items() if of == whole] for whole in methods}
        methods = [name for whole in methods for name in names[whole] or [whole]]
        # Each seed is treated as a method with one run.
        seeds = seeds[:1] if split == "seed" else seeds
    protocol = one_protocol(row.config for row in complete)
    finished, unusual = _prefer_usual(complete, split)
    _refuse_mixed(finished)
    values = [row.values | {key: lookup(row.config, key) for key in KEYS} for row in finished]
    columns = None if finished else [*NAMES, "score", "best_iteration", "config_hash", "path", *KEYS]
    counts = {
        "left out: not finished": len(inside) - len(complete),
        f"left out: request them by {advice}": len(ended) - len(complete),
        "left out: more settings that differ from conf/": len(complete) - len(finished),
    }
    left_out = [f"{count} run(s) {what}" for what, count in counts.items() if count]
    return Runs(
        table=pd.DataFrame(values, columns=columns).astype({"seed": str}),
        tasks=asked["task"],
        variants=asked["variant"],
        methods=methods,
        seeds=seeds,
        unusual=unusual,
        protocol=protocol,
        left_out=[*left_out, *(f"left out: {error}" for error in unreadable)],
        configs=[row.config for row in finished],
    )


def _split(
    found: Sequence[Row], key: str, places: Sequence[Path]
) -> tuple[list[Row], dict[tuple[str, Any], str]]:
    """Return runs whose methods are renamed if they have several values of a setting, and the new names by
    method and value."""
    pairs = [(row.values["method"], _split_value(row, key, places)) for row in found]
    new: dict[tuple[str, Any], str] = {}
    for name, value in sorted(set(pairs), key=lambda pair: (pair[0], isinstance(pair[1], str), pair[1])):
        if len({own for other, own in pairs if other == name}) > 1:
            new[name, value] = part(name, key.rpartition(".")[2], str(value), len(new))
    if not new:
        raise ArgumentError(
            f"no method has runs that differ in {key}: split by another key, such as method.lr, or by folder "
            "or seed"
        )
    renamed = [
        replace(row, values=row.values | {"method": new.get(pair, pair[0])})
        for row, pair in zip(found, pairs, strict=True)
    ]
    return renamed, new


def _split_value(row: Row, key: str, places: Sequence[Path]) -> Any:
    if key == "seed":
        return row.values["seed"]
    if key == "folder":
        return next(str(place) for place in places if row.path.is_relative_to(place))
    value = lookup(row.config, key)
    return value if isinstance(value, str | int | float) and value == value else json.dumps(value)


# --------------------------------------------------------------------------------------------------- settings


def _refuse_mixed(found: Sequence[Row]) -> None:
    """Reject runs of one configuration, or of one task and method, with different settings."""
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = defaultdict(list)
    by_name: dict[tuple[str, ...], Row] = {}
    for row in found:
        task, variant, name, seed = (str(row.values[name]) for name in NAMES)
        groups[task, name].append({key: row.config[key] for key in ("protocol", "sim", "method")})
        groups[f"{task}-v{variant}", name].append(row.config)
        other = by_name.setdefault((task, variant, name, seed), row)
        if other is not row:
            keys = [key for key in _differences([other.config, row.config]) if key != "results_dir"]
            how = f"choose one by {keys[0]}=" if keys else "remove one"
            raise ArgumentError(f"{other.path} and {row.path} have the same seed: {how}")
    for names, configs in groups.items():
        for key, values in _differences(configs).items():
            if key not in _IGNORED_KEYS:
                texts = " and ".join(map(str, values))
                advice = f"choose one, for example {key}={values[0]}"
                raise ArgumentError(f"runs of {' '.join(names)} differ in {key} ({texts}): {advice}")


def _differences(configs: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the dotted keys in which configurations differ, with their values."""
    # Most sections of thousands of runs are equal and need not be flattened.
    names = dict.fromkeys(name for config in configs for name in config)
    unlike = [name for name in names if any(own.get(name) != configs[0].get(name) for own in configs)]
    flat = [dict(leaves({name: config.get(name) for name in unlike})) for config in configs]
    seen = {
        key: {json.dumps(own.get(key)): own.get(key) for own in flat}
        for key in dict.fromkeys(key for own in flat for key in own)
    }
    return {key: list(values.values()) for key, values in seen.items() if len(values) > 1}


def _prefer_usual(found: Sequence[Row], split: str) -> tuple[list[Row], list[str]]:
    """Select, for each task and method, the runs with the fewest changes to plab's settings, not counting the
    key ``split``; return these runs, and their settings that differ from plab's."""
    changes = [changed_settings(row.config) for row in found]
    fewest: dict[tuple[str, str], int] = {}
    for row, changed in zip(found, changes, strict=True):
        changed.pop(split, None)
        pair = row.values["task"], row.values["method"]
        fewest[pair] = min(len(changed), fewest.get(pair, len(changed)))
    kept = []
    whose: dict[str, list[str]] = defaultdict(list)
    for row, changed in zip(found, changes, strict=True):
        if len(changed) == fewest[row.values["task"], row.values["method"]]:
            kept.append(row)
            for key, value in changed.items():
                whose[f"{key} = {value}"].append(method(row.values["method"]).label)
    return kept, [
        text if len(labels) == len(kept) else f"{text} (runs of {', '.join(sorted(set(labels)))})"
        for text, labels in sorted(whose.items())
    ]


def changed_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run that differ from plab's own files, by dotted key."""
    task, variant = config["task"], str(config["variant"])
    scene = _expected_scene(task["name"], variant, config["protocol"]["numbers"])
    expected = scene | _expected(config["method"]["name"], task["name"], config["protocol"]["name"])
    sections = [*(["method"] if "method.name" in expected else ()), *(SCENE if scene else ())]
    keys = [*expected, *(key for name in sections for key, _ in leaves(lookup(config, name), name))]
    # The values of random variants are sampled.
    drawn = {} if variant in SUITE_VARIANTS else dict(leaves(task["variants"].get(variant, {}), "task"))
    # None where the run or plab's file has no such setting.
    own = {key: lookup(config, key) for key in keys if key not in drawn and key not in _IGNORED_KEYS}
    own = {key: None if value != value else value for key, value in own.items()}
    own |= {key: value for key, value in leaves(task.get("randomize"), "task.randomize") if value}
    return {key: value for key, value in own.items() if value != expected.get(key)}


@functools.cache
def _expected(method: str, task: str, protocol: str) -> dict[str, Any]:
    """Return the settings of plab's files for a method, a task and a protocol, by dotted key, without the
    method if it is external."""
    # Composing needs Hydra.
    from plab.config import load_config
    from plab.config.overrides import quoted

    chosen = {"method": method, "protocol": protocol}
    chosen = {group: name for group, name in chosen.items() if name in choices(group)}
    # Learning rate and contact weight may depend on the name of the task. Composing its file is slow.
    words = [f"task.name={quoted(task)}", *(f"{group}={name}" for group, name in chosen.items())]
    config = config_dict(load_config(words))
    names = ["protocol", "sim", "seed_particles", *OBSERVATION_KEYS]
    names += ["method"] if "method" in chosen else []
    usual = dict(leaves({name: config[name] for name in names}))
    return {key: value for key, value in usual.items() if key not in _IGNORED_KEYS}


@functools.cache
def _expected_scene(task: str, variant: str, numbers: str) -> dict[str, Any]:
    """Return the settings of plab's file for a task and a variant, by dotted key; none for other tasks."""
    from omegaconf import OmegaConf

    own: Any = shipped_file("task", task)
    own = OmegaConf.merge(own, own.get("release", {}) if numbers == "release" else {})
    own = OmegaConf.merge(own, own.get("variants", {}).get(variant, {}))
    whole: Any = OmegaConf.to_container(own)
    kept = {name: own for name, own in whole.items() if f"task.{name}" in SCENE or not isinstance(own, dict)}
    return dict(leaves(kept, "task")) if kept else {}
