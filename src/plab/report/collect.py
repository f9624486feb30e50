"""Selection of finished runs of the suite that may be averaged, because they differ only in seed and
variant."""

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

from plab.config.selection import OBSERVATION_KEYS, Selection, leaves, lookup, one_protocol, require_possible
from plab.config.suite import PAPER_SEEDS, SUITE_VARIANTS, shipped_file, suite_tasks
from plab.errors import ArgumentError, PlabError
from plab.report.methods import method, ordered, part
from plab.results import Row, rows
from plab.results.running import held
from plab.results.table import sources_of

NAMES = ("task", "variant", "method", "seed")

KEYS = ("method.family", "method.iterations", "method.episodes", "sim.horizon")
"""Configuration keys that are columns of the table of runs."""

_SINGLE = ("seed_particles", *OBSERVATION_KEYS)
"""Top-level configuration keys that must agree within a mean."""

_IGNORED_KEYS = (
    *("seed", "results_dir", "force", "progress", "logger", "checkpoint_seconds", "protocol.name"),
    *("sim.device", "sim.memory_mb", "sim.deterministic", "method.torch_device", "method.torch_threads"),
    *("method.lr_by_task", "method.contact_by_task", "method.max_gradient_norm_by_numbers"),
    # Takes effect through method.loss_terms.contact.
    "protocol.contact",
    "task.release",
)
"""Keys that may differ within a mean."""


class MixedRunsError(PlabError, ValueError):
    """Runs that must not be averaged; the one-line message names the override that selects among them."""


@dataclass(frozen=True)
class Setting:
    """A setting that differs from plab's default.

    Attributes:
        key: Dotted key of the setting.
        value: Value of the setting.
        whose: Methods with this setting, with tasks and variants as far as needed; empty for all methods.
    """

    key: str
    value: Any
    whose: str

    def __str__(self) -> str:
        return f"{self.key} = {self.value}" + (f" ({self.whose})" if self.whose else "")


@dataclass(frozen=True)
class Runs:
    """Finished runs, and the requested ones.

    Attributes:
        table: Table of :func:`plab.results.load`, a row per run.
        tasks: Requested tasks.
        variants: Requested variants.
        methods: Requested methods, in the order of tables.
        seeds: Requested seeds.
        unfinished: Number of requested runs that are not finished and not in ``table``.
        under_way: Number of these runs in progress.
        others: Number of finished runs that were not requested.
        set_aside: Number of finished runs left out because others of the same task and method have fewer
            changes to plab's settings.
        unusual: Settings that differ from plab's.
        protocol: Name of their protocol.
        unreadable: Messages about files that could not be read.
        configs: Configurations of the runs, in the order of ``table``.
    """

    table: pd.DataFrame
    tasks: list[str]
    variants: list[str]
    methods: list[str]
    seeds: list[str]
    unfinished: int
    under_way: int
    others: int
    set_aside: int
    unusual: list[Setting]
    protocol: str
    unreadable: list[str]
    configs: list[dict[str, Any]]

    @property
    def digest(self) -> str:
        """SHA-256, in hex, of the runs' configurations, evaluations and times, independent of file
        locations."""
        records = self.table.drop(columns="path").to_dict("records")
        lines = sorted(
            json.dumps({name: value for name, value in row.items() if value == value}, sort_keys=True)
            for row in records
        )
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()

    @property
    def present(self) -> list[str]:
        """Methods with runs, in the order of tables."""
        names = set(self.table["method"])
        return [name for name in self.methods if name in names]

    @property
    def expected(self) -> int:
        """Number of requested runs of all tasks, variants and seeds, for methods that have runs."""
        return len(self.tasks) * len(self.variants) * len(self.seeds) * len(self.present)

    def left_out(self) -> list[str]:
        """Return notes on runs missing from ``table``, with reasons."""
        counts = (
            (self.unfinished, "are not finished, hence not in them"),
            (self.others, "are of other tasks, variants, methods or seeds, hence not in them"),
            (self.set_aside, "try other settings than conf/ has, hence are not in them"),
        )
        return [f"{count} run(s) {what}" for count, what in counts if count] + [
            f"left out: {message}" for message in self.unreadable
        ]


@dataclass(frozen=True)
class Ablation:
    """Runs that differ in one setting.

    Attributes:
        task: Name of the task.
        variant: Name of the variant.
        method: Name of the method.
        paths: Files of the runs, by the setting's value.
    """

    task: str
    variant: str
    method: str
    paths: dict[Any, list[Path]]


def collect(source: str | Path | Sequence[str | Path], chosen: Selection, split: str = "") -> Runs:
    """Find the runs for tables and curves.

    Args:
        source: Folder of results, archive, or several of them.
        chosen: Selection of runs; defaults: the suite's tasks and variants, the methods and seeds of the
            paper and of the results.
        split: Setting whose values are treated as separate methods: a dotted key, ``folder`` or ``seed``;
            none if empty.

    Raises:
        MixedRunsError: If runs of one mean differ in their settings, or have the same seed.
        plab.errors.ArgumentError: If there are runs of several protocols, or no runs differ in
            ``split``.
        plab.config.ConfigError: If the selection cannot match any run.
        plab.results.ResultsError: If ``source`` does not exist, or none of its files or archives can be read.
    """
    found, unreadable = rows(source)
    require_possible(chosen, found)
    fitting = [row for row in found if chosen(row.values, row.config)]
    asked = _asked(fitting, chosen)
    inside = [row for row in fitting if all(str(row.values[name]) in asked[name] for name in NAMES)]
    complete = [row for row in inside if row.values["status"] == "finished"]
    methods, seeds = asked["method"], asked["seed"]
    if split:
        complete, names = _split(complete, split, sources_of(source))
        methods = [name for whole in methods for name in names.get(whole, [whole])]
        # Each seed is treated as a method with one run.
        seeds = seeds[:1] if split == "seed" else seeds
    protocol = one_protocol(row.config for row in complete)
    finished, unusual = _prefer_usual(complete, split)
    _refuse_mixed(finished)
    values = [row.values | {key: lookup(row.config, key) for key in KEYS} for row in finished]
    columns = None if finished else [*NAMES, "score", "config_hash", "path", *KEYS]
    return Runs(
        table=pd.DataFrame(values, columns=columns).astype({"seed": str}),
        tasks=asked["task"],
        variants=asked["variant"],
        methods=methods,
        seeds=seeds,
        unfinished=len(inside) - len(complete),
        under_way=sum(held(row.path) for row in inside if row.values["status"] != "finished"),
        others=sum(row.values["status"] == "finished" for row in fitting) - len(complete),
        set_aside=len(complete) - len(finished),
        unusual=unusual,
        protocol=protocol,
        unreadable=[str(error) for error in unreadable],
        configs=[row.config for row in finished],
    )


def _asked(found: Sequence[Row], chosen: Selection) -> dict[str, list[str]]:
    seeds = {str(row.values["seed"]) for row in found} | set(PAPER_SEEDS)
    free = {
        "task": suite_tasks(),
        "variant": list(SUITE_VARIANTS),
        "method": ordered(row.values["method"] for row in found),
        "seed": sorted(seeds, key=int),
    }
    return {name: chosen.choices.get(name, free[name]) for name in NAMES}


def collect_ablation(
    source: str | Path | Sequence[str | Path], chosen: Selection, key: str
) -> Ablation | None:
    """Find the finished runs of one task, variant and method that differ in one setting.

    Args:
        source: Folder of results, archive, or several of them.
        chosen: Choice of runs.
        key: Dotted key of the setting.

    Returns:
        The task, variant and method with the most values; None if the setting never varies.

    Raises:
        MixedRunsError: If they differ in other settings, or have the same seed.
    """
    groups: dict[tuple[str, ...], dict[Any, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows(source)[0]:
        value = lookup(row.config, key)
        finished = row.values["status"] == "finished"
        if finished and chosen(row.values, row.config) and isinstance(value, str | int | float):
            groups[tuple(str(row.values[name]) for name in NAMES[:3])][value].append(row)
    (task, variant, method), by_value = max(
        groups.items(), key=lambda item: len(item[1]), default=(("", "", ""), {})
    )
    if len(by_value) < 2:
        return None
    what = f"{task}-v{variant} {method}"
    for value, same in by_value.items():
        _refuse_differing(f"{what}, {key} = {value}", [row.config for row in same])
        _refuse_repeated(same)
    _refuse_differing(what, [row.config for same in by_value.values() for row in same], apart=key)
    paths = {value: [row.path for row in same] for value, same in by_value.items()}
    return Ablation(task, variant, method, paths)


def _split(found: Sequence[Row], key: str, places: Sequence[Path]) -> tuple[list[Row], dict[str, list[str]]]:
    """Return runs with methods renamed if they have several values of a setting, and the new names by
    method."""
    texts = [_split_value(row, key, places) for row in found]
    methods = [row.values["method"] for row in found]
    new: dict[tuple[str, str], str] = {}
    for name in dict.fromkeys(methods):
        own = {text for of, text in zip(methods, texts, strict=True) if of == name}
        for text in sorted(own, key=_by_number) if len(own) > 1 else ():
            new[name, text] = part(name, key.rpartition(".")[2], text, len(new))
    if not new:
        raise ArgumentError(
            f"no method has runs that differ in {key}: split by a key in which they do, such as method.lr, "
            "or by folder or seed"
        )
    renamed = [
        replace(row, values=row.values | {"method": new.get((name, text), name)})
        for row, name, text in zip(found, methods, texts, strict=True)
    ]
    names: dict[str, list[str]] = defaultdict(list)
    for (name, _), own_name in new.items():
        names[name].append(own_name)
    return renamed, names


def _split_value(row: Row, key: str, places: Sequence[Path]) -> str:
    if key == "seed":
        return str(row.values["seed"])
    if key == "folder":
        return next(str(place) for place in places if row.path.is_relative_to(place))
    if "." not in key:
        raise ArgumentError(f"cannot split by '{key}': give a dotted key such as method.lr, folder or seed")
    value = lookup(row.config, key)
    if value is None or value != value:
        return "none"
    return value if isinstance(value, str) else json.dumps(value)


def _by_number(text: str) -> tuple[float, str]:
    try:
        return float(text), text
    except ValueError:
        return float("inf"), text


# --------------------------------------------------------------------------------------------------- settings


def _refuse_mixed(found: Sequence[Row]) -> None:
    """Reject runs of one configuration, or of one task and method, with different settings."""
    groups: dict[tuple[str, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in found:
        groups[row.values["task"], row.values["method"]][row.values["variant"]].append(row)
    for (task, name), variants in groups.items():
        every = [row.config for own in variants.values() for row in own]
        sections = [{key: config[key] for key in ("protocol", "sim", "method")} for config in every]
        _refuse_differing(f"{task} {name}", sections)
        for variant, same in variants.items():
            _refuse_differing(f"{task}-v{variant} {name}", [row.config for row in same])
            _refuse_repeated(same)


def _refuse_differing(what: str, configs: Sequence[Mapping[str, Any]], apart: str = "") -> None:
    for key, values in _differences(configs).items():
        if key not in _IGNORED_KEYS and key != apart:
            texts = " and ".join(map(str, values))
            advice = f"choose one, for example {key}={values[0]}"
            raise MixedRunsError(f"runs of {what} differ in {key}, which is {texts}: {advice}")


def _refuse_repeated(found: Sequence[Row]) -> None:
    by_seed: dict[str, Row] = {}
    for row in found:
        other = by_seed.setdefault(str(row.values["seed"]), row)
        if other is row:
            continue
        keys = [key for key in _differences([other.config, row.config]) if key != "results_dir"]
        how = f"choose one by {keys[0]}=" if keys else "remove one"
        raise MixedRunsError(f"{other.path} and {row.path} have the same seed: {how}")


def _differences(configs: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the dotted keys in which configurations differ, with the values that occur."""
    first = configs[0]
    # Most sections of thousands of runs are equal and need not be flattened.
    unlike = {
        name
        for config in configs[1:]
        for name in config.keys() | first.keys()
        if config.get(name) != first.get(name)
    }
    flat = [dict(leaves({name: config[name] for name in config if name in unlike})) for config in configs]
    seen = {
        key: {json.dumps(own.get(key)): own.get(key) for own in flat}
        for key in dict.fromkeys(key for own in flat for key in own)
    }
    return {key: list(values.values()) for key, values in seen.items() if len(values) > 1}


def _prefer_usual(found: Sequence[Row], apart: str) -> tuple[list[Row], list[Setting]]:
    """Select, for each task and method, the runs with the fewest changes to plab's settings.

    Args:
        found: The runs.
        apart: Key that is not counted as a change.

    Returns:
        These runs, and their settings that differ from plab's.
    """
    changes = [
        {key: value for key, value in changed_settings(row.config).items() if key != apart} for row in found
    ]
    pairs = [(row.values["task"], row.values["method"]) for row in found]
    fewest: dict[tuple[str, str], int] = {}
    for pair, changed in zip(pairs, changes, strict=True):
        fewest[pair] = min(len(changed), fewest.get(pair, len(changed)))
    kept = []
    whose: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row, pair, changed in zip(found, pairs, changes, strict=True):
        if len(changed) == fewest[pair]:
            kept.append(row)
            for key, value in changed.items():
                whose[key, json.dumps(value)].append(row)
    return kept, [
        Setting(key, json.loads(text), _described(own, kept)) for (key, text), own in sorted(whose.items())
    ]


def _described(own: Sequence[Row], every: Sequence[Row]) -> str:
    """Return the shortest description that distinguishes some runs from all others; empty if there are no
    others."""
    for names in ((), ("method",), ("method", "task"), ("method", "task", "variant")):
        kinds = {tuple(row.values[name] for name in names) for row in own}
        if sum(tuple(row.values[name] for name in names) in kinds for row in every) == len(own):
            break
    texts = [
        f"{method(kind[0]).label}{' on ' if kind[1:] else ''}{'-v'.join(kind[1:])}"
        for kind in sorted(kinds)
        if kind
    ]
    return ", ".join(texts[:3]) + (f" and {len(texts) - 3} more" if len(texts) > 3 else "")


def changed_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run that differ from plab's own files, by dotted key."""
    variants = config["task"].get("variants") or {}
    by_variant = {f"task.{key}" for key in variants.get(str(config["variant"]), {})}
    expected = _expected(config["method"]["name"], config["task"]["name"], config["protocol"]["name"])
    own = {key: lookup(config, key) for key in expected if key not in by_variant}
    # None where the run has no such setting.
    own = {key: None if value != value else value for key, value in own.items()}
    return {key: value for key, value in own.items() if value != expected[key]}


@functools.cache
def _expected(method: str, task: str, protocol: str) -> dict[str, Any]:
    """Return the settings of plab's files for a method, a task and a protocol, by dotted key."""
    usual = dict(_default_settings(method, protocol))
    # Learning rate and contact weight may have values by task.
    for key, section, choice in (
        ("method.lr", "lr_by_task", "protocol.numbers"),
        ("method.loss_weights.contact", "contact_by_task", "protocol.contact"),
    ):
        values = shipped_file("method", method).get(section, {}).get(usual[choice], {})
        if (value := values.get(task, values.get("other"))) is not None:
            usual[key] = value
    own = shipped_file("task", task)
    if usual["protocol.numbers"] == "release":
        own = own | own.get("release", {})
    # Bodies, manipulators, targets and variants may be changed freely.
    usual |= {f"task.{key}": value for key, value in own.items() if not isinstance(value, dict)}
    return {key: value for key, value in usual.items() if key not in _IGNORED_KEYS}


@functools.cache
def _default_settings(method: str, protocol: str) -> dict[str, Any]:
    """Return method, protocol and sim of plab's files, without the method if it is not plab's."""
    # Composing needs Hydra.
    from plab.config import choices, load_config
    from plab.results import config_dict

    known = method in choices("method")
    words = [f"method={method}"] if known else []
    words += [f"protocol={protocol}"] if protocol in choices("protocol") else []
    config = config_dict(load_config(words))
    names = ["protocol", "sim", *_SINGLE, *(["method"] if known else [])]
    return dict(leaves({name: config[name] for name in names}))
