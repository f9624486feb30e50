"""The runs that tables and curves are made of: finished, of the suite, and all of the same settings."""

from __future__ import annotations

import functools
import hashlib
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from plab.config.selection import OBSERVED, Selection, one_protocol, require_possible
from plab.config.suite import PAPER_SEEDS, SUITE_VARIANTS, shipped_file, suite_tasks
from plab.errors import PlabError
from plab.report.methods import method, ordered
from plab.report.splitting import SEED, split_rows
from plab.results import Row, lookup, rows
from plab.results.loading import readable_rows, sources_of
from plab.results.locks import held

__all__ = [
    "KEYS",
    "NAMES",
    "Ablation",
    "MixedRunsError",
    "Runs",
    "Setting",
    "changed_settings",
    "collect",
    "collect_ablation",
]

NAMES = ("task", "variant", "method", "seed")

KEYS = ("method.family", "method.iterations", "method.episodes", "sim.horizon")
"""Configuration keys that the table of runs has as columns."""

_SINGLE = ("seed_particles", *OBSERVED)
"""What is in no section of a configuration and matters to a mean."""

_HARMLESS = (
    "seed",
    "results_dir",
    "force",
    "progress",
    "logger",
    "checkpoint_seconds",
    "protocol.name",
    "sim.device",
    "sim.memory_mb",
    "sim.deterministic",
    "method.tensorboard",
    "method.lr_by_task",
    "method.contact_by_task",
    "method.max_gradient_norm_by_numbers",
    "method.torch_device",
    "method.torch_threads",
    # Acts where method.loss_terms.contact says so.
    "protocol.contact",
    # Empty, or older than it.
    "task.release",
)
"""Keys in which the runs of one mean may differ."""


class MixedRunsError(PlabError, ValueError):
    """Runs that do not belong into one mean; the message is one line that says how to choose."""


@dataclass(frozen=True)
class Setting:
    """A setting that is not plab's own.

    Attributes:
        key: The setting, dotted.
        value: Its value.
        whose: Methods, with tasks and variants as far as needed, whose runs have it; empty if all have.
    """

    key: str
    value: Any
    whose: str

    def __str__(self) -> str:
        return f"{self.key} = {self.value}" + (f" ({self.whose})" if self.whose else "")


@dataclass(frozen=True)
class Runs:
    """Finished runs, and which ones there should be.

    Attributes:
        table: As :func:`plab.results.load` gives it, a row per run.
        tasks: Tasks asked for.
        variants: Variants asked for.
        methods: Methods asked for, in the order of tables.
        seeds: Seeds asked for.
        unfinished: Number of runs of theirs that are not finished, hence not in ``table``.
        under_way: How many of them are being computed at this moment.
        others: Number of finished runs that belong to nothing asked for.
        set_aside: Number of finished runs with more changes to plab's own settings than others of the same
            task and method have.
        unusual: Settings other than plab's own.
        protocol: Name of their protocol.
        unreadable: What could not be read.
        configs: Their configurations, in the order of ``table``.
        source: Where they were found.
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
    source: str | Path | Sequence[str | Path]

    @property
    def digest(self) -> str:
        """SHA-256, in hex, over the runs' configurations, evaluations and times, wherever their files are."""
        lines = sorted(_fingerprint(row) for row in self.table.drop(columns="path").to_dict("records"))
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()

    def left_out(self) -> list[str]:
        """Say which runs are not in ``table``, and why; nothing where all are."""
        counts = (
            (self.unfinished, "are not finished, hence not in them"),
            (self.others, "are of other tasks, variants, methods or seeds, hence not in them"),
            (self.set_aside, "try other settings than conf/ has, hence are not in them"),
            (len(self.unreadable), "cannot be read: python -m plab.results check"),
        )
        return [f"{count} run(s) {what}" for count, what in counts if count]


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
        chosen: Which runs; what it leaves open is the suite's tasks and variants, the paper's methods and
            seeds, and further methods and seeds that the results have.
        split: Setting whose values are taken for methods of their own, see
            :func:`plab.report.splitting.split_rows`; none if empty.

    Raises:
        plab.report.splitting.SplitError: If there is nothing to split.
        MixedRunsError: If runs of one mean differ in their settings, or there are two of one seed.
        plab.config.selection.SelectionError: If there are runs of several protocols.
        plab.config.ConfigError: If no run can be of the choice.
        plab.results.ResultsError: If there is nothing at ``source``, or files or archives of which none
            can be read.
    """
    found, unreadable = readable_rows(source)
    require_possible(chosen, found)
    fitting = [row for row in _with_contact_terms(found) if chosen(row.values, row.config)]
    asked = _asked(fitting, chosen)
    inside = [row for row in fitting if all(str(row.values[name]) in asked[name] for name in NAMES)]
    complete = [row for row in inside if row.values["status"] == "finished"]
    methods, seeds = asked["method"], asked["seed"]
    if split:
        complete, names = split_rows(complete, split, sources_of(source))
        methods = [name for whole in methods for name in names.get(whole, [whole])]
        # Of each seed that is a method of its own there is one run.
        seeds = seeds[:1] if split == SEED else seeds
    protocol = one_protocol(row.config for row in complete)
    finished, unusual = _prefer_usual(complete, split)
    _refuse_mixed(finished)
    values = [row.values | {key: lookup(row.config, key) for key in KEYS} for row in finished]
    table = pd.DataFrame(
        values, columns=None if finished else [*NAMES, "score", "config_hash", "path", *KEYS]
    )
    return Runs(
        table=table.astype({"seed": str}),
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
        source=source,
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
        chosen: Which runs.
        key: The setting, dotted.

    Returns:
        Those in which it takes the most values; None where it never takes more than one.

    Raises:
        MixedRunsError: If they differ in more than that, or there are two of one seed.
    """
    found = [row for row in rows(source)[0] if row.values["status"] == "finished"]
    groups: dict[tuple[str, ...], dict[Any, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in found:
        value = lookup(row.config, key)
        if chosen(row.values, row.config) and isinstance(value, str | int | float):
            groups[tuple(str(row.values[name]) for name in NAMES[:3])][value].append(row)
    if not groups:
        return None
    (task, variant, method), by_value = max(groups.items(), key=lambda item: len(item[1]))
    if len(by_value) < 2:
        return None
    for value, same in by_value.items():
        _refuse_differing(f"{task}-v{variant} {method}, {key} = {value}", [row.config for row in same])
        _refuse_repeated(same)
    every = [row.config for same in by_value.values() for row in same]
    _refuse_differing(f"{task}-v{variant} {method}", every, apart=key)
    paths = {value: [row.path for row in same] for value, same in by_value.items()}
    return Ablation(task, variant, method, paths)


# --------------------------------------------------------------------------------------------------- settings


def _refuse_mixed(found: Sequence[Row]) -> None:
    """Refuse runs of one configuration, or of one task and method, that differ in what matters."""
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in found:
        groups[row.values["task"], row.values["method"]].append(row)
    for (task, name), own in groups.items():
        sections = ("protocol", "sim", "method")
        _refuse_differing(f"{task} {name}", [{key: row.config[key] for key in sections} for row in own])
        variants: dict[str, list[Row]] = defaultdict(list)
        for row in own:
            variants[row.values["variant"]].append(row)
        for variant, same in variants.items():
            _refuse_differing(f"{task}-v{variant} {name}", [row.config for row in same])
            _refuse_repeated(same)


def _with_contact_terms(found: Sequence[Row]) -> list[Row]:
    """Have runs from before the contact term had variants say which one they had."""
    # Of thousands of runs most share their sections, which stay the same objects.
    methods = {id(row.config["method"]): row.config["method"] for row in found}
    known = {number: _with_contact_term(method) for number, method in methods.items()}
    return [
        replace(row, config={**row.config, "method": known[id(row.config["method"])]})
        if "loss_terms" not in row.config["method"]
        else row
        for row in found
    ]


def _with_contact_term(method: dict[str, Any]) -> dict[str, Any]:
    """Return the section of a method, with the contact term that there was if it is older than the choice."""
    if "loss_terms" in method or "contact" not in method.get("loss_weights", {}):
        return method
    return method | {"loss_terms": {"contact": "nearest"}}


def _refuse_differing(what: str, configs: Sequence[Mapping[str, Any]], apart: str = "") -> None:
    for key, values in _differences(configs).items():
        if key not in _HARMLESS and key != apart:
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
    # Of thousands of runs most share their sections, as the same objects.
    unlike = {
        name
        for config in configs[1:]
        for name in config.keys() | first.keys()
        if config.get(name) is not first.get(name) and config.get(name) != first.get(name)
    }
    seen: dict[str, dict[str, Any]] = defaultdict(dict)
    flat = [dict(_leaves({name: config[name] for name in config if name in unlike})) for config in configs]
    for key in dict.fromkeys(key for leaves in flat for key in leaves):
        for leaves in flat:
            value = leaves.get(key)
            seen[key].setdefault(json.dumps(value), value)
    return {key: list(values.values()) for key, values in seen.items() if len(values) > 1}


def _leaves(node: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def _prefer_usual(found: Sequence[Row], apart: str) -> tuple[list[Row], list[Setting]]:
    """Of each task and method, keep the runs in plab's own settings, or in those with the fewest changes.

    Args:
        found: The runs.
        apart: Key that is no such setting.

    Returns:
        These runs, and their settings that are not those of plab's own files.
    """
    changes = [{key: value for key, value in changed.items() if key != apart} for changed in _changes(found)]
    fewest: dict[tuple[str, str], int] = {}
    for row, changed in zip(found, changes, strict=True):
        fewest[_pair(row)] = min(len(changed), fewest.get(_pair(row), len(changed)))
    kept = []
    whose: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row, changed in zip(found, changes, strict=True):
        if len(changed) == fewest[_pair(row)]:
            kept.append(row)
            for key, value in changed.items():
                whose[key, json.dumps(value)].append(row)
    return kept, [
        Setting(key, json.loads(text), _whose(own, kept)) for (key, text), own in sorted(whose.items())
    ]


def _whose(own: Sequence[Row], every: Sequence[Row]) -> str:
    """Say which runs of all these are, in as few words as tell them: nothing where they are all."""
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


def _changes(found: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the :func:`changed_settings` of each run; of thousands most share their sections."""
    known: dict[tuple[Any, ...], dict[str, Any]] = {}
    changes = []
    for row in found:
        sections = (id(row.config[name]) for name in ("task", "method", "protocol", "sim"))
        which = (*sections, row.values["variant"], *(row.config[name] for name in _SINGLE))
        if which not in known:
            known[which] = changed_settings(row.config)
        changes.append(known[which])
    return changes


def _pair(row: Row) -> tuple[str, str]:
    return row.values["task"], row.values["method"]


def changed_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's settings that are not those of plab's own files, by dotted key.

    Args:
        config: The run's configuration.
    """
    config = {**config, "method": _with_contact_term(config["method"])}
    by_variant = {f"task.{key}" for key in _changed_by_variant(config)}
    expected = _expected(config["method"]["name"], config["task"]["name"], config["protocol"]["name"])
    own = {key: lookup(config, key) for key in expected if key not in by_variant}
    # None where the run is older than the setting: that it did without, as null says.
    own = {key: None if value != value else value for key, value in own.items()}
    return {key: value for key, value in own.items() if value != expected[key]}


@functools.cache
def _expected(method: str, task: str, protocol: str) -> dict[str, Any]:
    """Return what a method and a task have in plab's files under a protocol, by dotted key, but for what does
    not matter."""
    usual = _usual(method, protocol)
    usual = usual | _usual_by_task(method, task, usual)
    exact = usual["protocol.numbers"] == "release"
    usual |= {f"task.{key}": value for key, value in _usual_task(task, exact).items()}
    return {key: value for key, value in usual.items() if key not in _HARMLESS}


@functools.cache
def _usual(method: str, protocol: str) -> dict[str, Any]:
    """Return method, protocol and sim as plab's files have them; all but the method of one that plab does not
    know, and plab's own protocol for one that it does not know."""
    # Imported here: composing needs Hydra.
    from plab.config import choices, load_config
    from plab.results import config_dict

    known = method in choices("method")
    words = [f"method={method}"] if known else []
    words += [f"protocol={protocol}"] if protocol in choices("protocol") else []
    config = config_dict(load_config(words))
    names = ["protocol", "sim", *_SINGLE, *(["method"] if known else [])]
    return dict(_leaves({name: config[name] for name in names}))


def _usual_by_task(method: str, task: str, usual: Mapping[str, Any]) -> dict[str, float]:
    """Return learning rate and contact weight of a method that has some of its own for the task."""
    places = (
        ("method.lr", "lr_by_task", "protocol.numbers"),
        ("method.loss_weights.contact", "contact_by_task", "protocol.contact"),
    )
    own = shipped_file("method", method)
    tasks = {key: own.get(section, {}).get(usual[choice], {}) for key, section, choice in places}
    found = {key: values.get(task, values.get("other")) for key, values in tasks.items()}
    return {key: value for key, value in found.items() if value is not None}


def _usual_task(task: str, exact: bool) -> dict[str, Any]:
    """Return the numbers of a task that are no part of bodies, manipulators, target or variants, the
    release's if they are to be ``exact``."""
    own = shipped_file("task", task)
    own = own | own.get("release", {}) if exact else own
    return {key: value for key, value in own.items() if not isinstance(value, dict)}


def _changed_by_variant(config: Mapping[str, Any]) -> Mapping[str, Any]:
    variants = config["task"].get("variants") or {}
    return variants.get(str(config["variant"]), {})


def _fingerprint(values: Mapping[str, Any]) -> str:
    return json.dumps({name: value for name, value in values.items() if value == value}, sort_keys=True)
