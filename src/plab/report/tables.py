"""Tables of results: scores per task and configuration, solvability, equal budgets and times per step; and
tables of hyper-parameters, read from ``conf/method/``."""

from __future__ import annotations

import functools
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd

from plab.config.families import GRADIENT, RL
from plab.config.suite import PAPER_METHODS, PAPER_SEEDS, SUITE_VARIANTS, shipped_file
from plab.report.collect import Runs
from plab.report.methods import method
from plab.report.reference import origin, paper_table
from plab.report.statistics import (
    BUDGETS,
    CONFIDENCE,
    Interval,
    Series,
    Summary,
    at_budgets,
    scores_at,
    strata_of,
    stratified_difference,
    summarise,
)

NOTHING = "\N{EN DASH}"
"""Placeholder for missing numbers."""

MINUS = "\N{MINUS SIGN}"
"""Sign of negative numbers."""


@dataclass(frozen=True)
class Table:
    """A table of the report.

    Attributes:
        name: Name of the files.
        form: Folder: ``ours`` or ``comparison`` (with the paper).
        title: Heading.
        cells: Text of the table.
        data: CSV rows with all digits, one per number or group of numbers.
        bold: Mask of bold cells, of the shape of ``cells``; None without bold cells.
        notes: Notes on the contents and the provenance of the table.
        long: Whether the table may be longer than a page.
    """

    name: str
    form: str
    title: str
    cells: pd.DataFrame
    data: pd.DataFrame
    bold: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    long: bool = False


def number(value: float, decimals: int = 2, *, sign: bool = False) -> str:
    """Format a number with a minus sign instead of a hyphen; missing numbers become a dash."""
    if math.isnan(value):
        return NOTHING
    # Without a minus sign for values rounded to zero.
    rounded = round(value, decimals) + 0.0
    text = f"{rounded:+.{decimals}f}" if sign else f"{rounded:.{decimals}f}"
    return text.replace("-", MINUS)


def aligned(cells: pd.DataFrame) -> list[str]:
    """Return the alignment of each column: ``r`` for numbers, otherwise ``l``."""
    known = ([text for text in own if text not in ("", NOTHING)] for _, own in cells.astype(str).items())
    return ["r" if texts and all(map(_NUMBER.match, texts)) else "l" for texts in known]


_NUMBER = re.compile(rf"\[?[+{MINUS}]?\d[\d.,]*(e[-+]?\d+)?(?![\d.,A-Za-z_])")
"""Pattern of numeric cells: a fraction of runs, an interval, a mean with its spread, a unit."""


def mean_and_std(summary: Summary, decimals: int = 2) -> str:
    """Format a mean with its standard deviation, which is omitted for a single number."""
    mean = number(summary.mean, decimals)
    return mean if summary.count < 2 else f"{mean} ± {number(summary.std, decimals)}"


_INCOMPLETE = "A cell with fewer runs than expected shows their number; it and its competitors are not bold."
_BOLD = "Bold: best RL method and best gradient method."
_DIFFERENCE = (
    "Difference: ours minus the paper's, mean over the variants with runs, with Welch's "
    f"{CONFIDENCE:.0%} interval from the variances within variants; no interval if a variant has one run."
)
DISTANCES = {"chamfer": "Chamfer", "earth_movers": "earth mover's"}
"""Headings of distances by result column."""

INTERVAL = f"{CONFIDENCE:.0%} interval"
"""Heading of intervals."""


def compare(runs: Runs, unit: str) -> pd.DataFrame:
    """Compare our scores with the paper's.

    Args:
        runs: Our runs.
        unit: ``task``, or ``configuration`` for a row per variant.

    Returns:
        Columns task, variant (if ``unit`` is ``configuration``), method; mean, std and runs of our scores,
        and the expected number of runs; ``paper_mean``, ``paper_std`` and ``paper_runs`` (of the whole method
        if it was split); and difference (ours minus the paper's, for a task the mean over common variants)
        with its interval, low and high.
    """
    groups = runs.table.groupby(["task", "variant", "method"])["score"]
    scores = {key: own.to_numpy(float) for key, own in groups}
    whole, single = _paper_scores("iou_per_task"), _paper_scores("iou_per_configuration")
    nothing = summarise([])
    units = [runs.variants] if unit == "task" else [[variant] for variant in runs.variants]
    rows = []
    for task, variants, name in itertools.product(ordered_tasks(runs.tasks), units, runs.methods):
        of = method(name).of or name
        own = [scores.get((task, variant, name), np.array([])) for variant in variants]
        theirs = [single.get((task, variant, of), nothing) for variant in variants]
        paper = whole.get((task, of), nothing) if unit == "task" else theirs[0]
        gap = stratified_difference([summarise(values) for values in own], theirs)
        rows.append(
            {"task": task, **({} if unit == "task" else {"variant": variants[0]}), "method": name}
            | {**_numbers(summarise(np.concatenate(own))), "expected": len(variants) * len(runs.seeds)}
            | {f"paper_{key}": value for key, value in _numbers(paper).items()}
            | {"difference": gap.value, "low": gap.low, "high": gap.high}
        )
    return pd.DataFrame(rows)


@functools.cache
def _paper_scores(name: str) -> Mapping[tuple[str, ...], Summary]:
    """Return the paper's scores by task, variant (if the table has variants) and method."""
    count = len(PAPER_SEEDS) * (len(SUITE_VARIANTS) if name == "iou_per_task" else 1)
    rows = paper_table(name).itertuples(index=False, name=None)
    return {tuple(key): Summary(mean, std, count) for *key, mean, std in rows}


def _in_paper(name: str) -> bool:
    return (method(name).of or name) in PAPER_METHODS


def ordered_tasks(tasks: Sequence[str]) -> list[str]:
    """Return tasks in the paper's order, followed by other tasks."""
    papers = list(dict.fromkeys(paper_table("iou_per_configuration")["task"]))
    return sorted(tasks, key=lambda task: (papers.index(task) if task in papers else len(papers), task))


def settings_note(runs: Runs) -> list[str]:
    """Return notes on the protocol and on settings that differ from plab's."""
    protocol = [] if runs.protocol == "plab" else [f"Protocol: {runs.protocol}."]
    if not runs.unusual:
        return protocol
    shown, more = runs.unusual[:6], len(runs.unusual) - 6
    other = "the protocol's own" if protocol else "plab's own"
    return [
        *protocol,
        f"Settings other than {other}: {'; '.join(shown)}{f'; and {more} more' if more > 0 else ''}.",
    ]


def format_interval(interval: Interval) -> str:
    """Format an interval; missing intervals become a dash."""
    if np.isnan(interval.low):
        return NOTHING
    return f"[{number(interval.low, sign=True)}, {number(interval.high, sign=True)}]"


# -------------------------------------------------------------------------------------------- incremental IoU


def iou_tables(runs: Runs, unit: str) -> list[Table]:
    """Return normalised incremental IoU by method: ours, and compared with the paper's.

    Args:
        runs: Our runs.
        unit: ``task``, or ``configuration`` for a row per variant.
    """
    name, title = f"iou_per_{unit}", f"Normalised incremental IoU per {unit}"
    keys = ["task"] if unit == "task" else ["task", "variant"]
    data = compare(runs, unit)
    data["text"] = list(map(_text, data["mean"], data["std"], data["runs"], data["expected"]))
    # Rows of a line are in the order of methods.
    lines = [own for _, own in data.groupby(keys, sort=False)]
    labels = [*keys, *(method(m).label for m in runs.methods)]
    shown = pd.DataFrame([[*own[keys].iloc[0], *own["text"]] for own in lines], columns=labels)
    bold = np.array([[False] * len(keys) + _best(own) for own in lines])
    ours = data[[*keys, "method", "mean", "std", "runs", "expected"]]
    common = data[data["method"].map(_in_paper)]
    papers = list(map(_text, common["paper_mean"], common["paper_std"], common["paper_runs"]))
    gaps = [Interval(*own) for own in common[["difference", "low", "high"]].itertuples(index=False)]
    compared = common[keys].assign(method=[method(m).label for m in common["method"]], plab=common["text"])
    compared = compared.assign(paper=papers, difference=[number(gap.value, sign=True) for gap in gaps])
    compared[INTERVAL] = list(map(format_interval, gaps))
    mean = f"Mean ± standard deviation over {'variants and seeds' if unit == 'task' else 'seeds'}."
    notes, other = [mean, _BOLD, _INCOMPLETE, *settings_note(runs)], [_DIFFERENCE, *settings_note(runs)]
    numbers = common.drop(columns="text")
    return [
        Table(name, "ours", f"{title}, plab", shown, ours, bold, notes, len(shown) > 60),
        Table(name, "comparison", f"{title}, compared", compared, numbers, None, other, True),
    ]


def distances(runs: Runs) -> list[Table]:
    """Return the distances of final shapes from targets per task and method, or nothing."""
    shown, data = [], []
    known = [name for name in DISTANCES if name in runs.table]
    for task, name in itertools.product(ordered_tasks(list(set(runs.table["task"]))), known):
        own = runs.table[runs.table["task"] == task]
        found = {
            m: summarise(own.loc[own["method"] == m, name].dropna().to_numpy(float)) for m in runs.methods
        }
        texts = (mean_and_std(one, 3) if one.count else NOTHING for one in found.values())
        shown.append([task, DISTANCES[name], *texts])
        data += [{"task": task, "distance": name, "method": m, **_numbers(one)} for m, one in found.items()]
    cells = pd.DataFrame(shown, columns=["task", "distance", *(method(m).label for m in runs.methods)])
    notes = ["Mean ± standard deviation over variants and seeds [domain units].", *settings_note(runs)]
    title = "Distance of the final shape from the target, plab"
    return [Table("distances", "ours", title, cells, pd.DataFrame(data), None, notes)] if shown else []


def _text(mean: float, std: float, count: int, expected: int = 0) -> str:
    """Format mean and standard deviation, and the number of runs if some are missing."""
    if not count:
        return f"0/{expected}" if expected else NOTHING
    return mean_and_std(Summary(mean, std, count)) + (f" ({count}/{expected})" if count < expected else "")


def _numbers(summary: Summary) -> dict[str, float]:
    """Return values for a CSV file by column."""
    return {"mean": summary.mean, "std": summary.std, "runs": summary.count}


def _best(line: pd.DataFrame) -> list[bool]:
    """Return the mask of the best methods per kind, comparing displayed values; no method is best if a cell
    is incomplete."""
    best = pd.Series(False, line["method"])
    scores = line.set_index("method")
    for kind in (RL, GRADIENT):
        own = [m for m in scores.index if method(m).kind == kind]
        rivals = scores.loc[[m for m in own if _in_paper(m) or scores.loc[m, "runs"]]]
        if len(rivals) and (rivals["runs"] >= rivals["expected"]).all():
            printed = rivals["mean"].map(lambda mean: round(mean, 2))
            best[printed.index] = printed == printed.max()
    return best.to_list()


# -------------------------------------------------------------------------------------------------- agreement

TOLERANCE = 0.1
"""Tolerance for differences of scores, about the spread of the paper's runs of one configuration (mean
standard deviation 0.09)."""

AGREES = f"within two of the paper's standard deviations or {TOLERANCE:g} of its mean"
"""Criterion for the agreement of a cell."""


def compared_cells(runs: Runs) -> pd.DataFrame:
    """Return the common cells, one row per task, variant and method.

    Returns:
        Columns task, variant, method, ours, paper, paper_std (of the population), paper_runs, runs,
        difference (ours minus the paper's) and agrees (whether it is within two standard deviations or the
        tolerance).
    """
    cells = compare(runs, "configuration").query("runs > 0 and paper_runs > 0").reset_index(drop=True)
    cells = cells.rename(columns={"mean": "ours", "paper_mean": "paper"})
    cells = cells[["task", "variant", "method", "ours", "paper", "paper_std", "paper_runs", "runs"]]
    apart = cells["ours"] - cells["paper"]
    allowed = np.maximum(2.0 * cells["paper_std"], TOLERANCE)
    return cells.assign(difference=apart, agrees=apart.abs() <= allowed)


def agreement(runs: Runs) -> list[Table]:
    """Return the agreement per method, per kind of method and overall, or nothing without common cells."""
    cells = compared_cells(runs)
    if cells.empty:
        return []
    groups = [(method(name).label, own) for name, own in cells.groupby("method", sort=False)]
    by_kind = cells.groupby(cells["method"].map(lambda name: method(name).kind))
    groups += [(f"all {kind}", own) for kind, own in by_kind] if len(by_kind) > 1 else []
    groups.append(("all", cells))
    data = pd.DataFrame([{"method": label} | overall_agreement(own) for label, own in groups])
    shown = pd.DataFrame(
        {
            "method": data["method"],
            "cells": data["cells"].map(str),
            "correlation": data["correlation"].map(number),
            "expected": data["expected"].map(number),
            "mean distance": data["distance"].map(number),
            "mean difference": [number(value, sign=True) for value in data["difference"]],
            "agree": [f"{number(100.0 * share, 0)} %" for share in data["agree"]],
        }
    )
    notes = [
        "Mean scores of common configurations. Correlation: Pearson's; expected: if the paper's runs were "
        "repeated as often as ours, given its standard deviations. Distance: absolute difference of the "
        f"means; difference: ours minus the paper's. Agree: {AGREES}.",
        *settings_note(runs),
    ]
    return [Table("agreement", "comparison", "Agreement with the paper's table", shown, data, notes=notes)]


def overall_agreement(cells: pd.DataFrame) -> dict[str, float]:
    """Return the overall agreement of some of the :func:`compared_cells`.

    Returns:
        Number of ``cells``, ``correlation`` (NaN without variation), the correlation ``expected`` if the
        paper's runs were repeated as often as ours, mean ``distance``, mean ``difference``, and the fraction
        ``agree``.
    """
    # Noise of the means lowers a correlation (Spearman 1904, attenuation).
    one_run = cells["paper_std"] ** 2 * cells["paper_runs"] / (cells["paper_runs"] - 1)
    variance = cells["paper"].var()
    true = variance - (one_run / cells["paper_runs"]).mean()
    repeated = true + (one_run / cells["runs"]).mean()
    return {
        "cells": len(cells),
        "correlation": cells["ours"].corr(cells["paper"]),
        "expected": true / np.sqrt(variance * repeated) if true > 0 else float("nan"),
        "distance": cells["difference"].abs().mean(),
        "difference": cells["difference"].mean(),
        "agree": cells["agrees"].mean(),
    }


# ------------------------------------------------------------------------------------------------ solvability


def solvability(runs: Runs) -> list[Table]:
    """Return the scores of the demonstrations next to those of the paper's best method."""
    ours, paper = demonstration_scores(), _paper_scores("iou_per_configuration")
    scores = ours.set_index(["task", "variant"])["score"]
    rows, cells = [], []
    for place in itertools.product(ordered_tasks(runs.tasks), runs.variants):
        score = scores.get(place, float("nan"))
        rivals = {name: own for (*key, name), own in paper.items() if tuple(key) == place}
        best, theirs = max(rivals.items(), key=lambda pair: pair[1].mean, default=("", summarise([])))
        # A replay has no spread, so the interval is the paper's.
        gap = stratified_difference([Summary(score, 0.0, 2 * (score == score))], [theirs])
        rows.append((*place, score, best, theirs.mean, theirs.std, gap.value, gap.low, gap.high))
        printed = f"{mean_and_std(theirs)} ({method(best).label})" if best else NOTHING
        cells.append((*place, number(score), printed, number(gap.value, sign=True), format_interval(gap)))
    names = ["task", "variant", "score", *(f"paper_{name}" for name in ("method", "mean", "std"))]
    data = pd.DataFrame(rows, columns=[*names, "difference", "low", "high"])
    heads = ["task", "variant", "demonstration", "paper, best method", "difference", INTERVAL]
    notes = [
        "Normalised incremental IoU of the best known actions, replayed in the hard contact model.",
        "Our targets are generated from parameters or scripts, the paper's are files, so the goals of "
        "the two columns differ slightly. The interval is Student's t over the paper's seeds.",
    ]
    title = "Demonstrations and the best method of the paper"
    shown = pd.DataFrame(cells, columns=heads)
    return [Table("solvability", "comparison", title, shown, data, None, notes, True)]


def demonstration_scores() -> pd.DataFrame:
    """Return the scores of the reference demonstrations, columns task, variant and score."""
    with (files("plab.demonstrations") / "scores.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file, dtype={"variant": str})


# ---------------------------------------------------------------------------------------------- equal budgets


def score_at_budget(runs: Runs, series: Series) -> list[Table]:
    """Return the table of scores at equal budgets, with one row per task and method."""
    budgets, rows, cells = np.array(BUDGETS), [], []
    for task in ordered_tasks(runs.tasks):
        strata = strata_of(series, task)
        for name in (one for one in runs.methods if one in strata):
            tables = [table for own in strata[name] for table in own]
            spent = np.mean([scores_at(table, budgets, "seconds") for table in tables], axis=0)
            what, texts = {"task": task, "method": name, "runs": len(tables)}, {}
            for budget, one, seconds in zip(budgets, at_budgets(strata[name], budgets), spent, strict=True):
                interval = "" if np.isnan(one.low) else f" [{number(one.low)}, {number(one.high)}]"
                texts[f"{budget:,.0f} steps"] = number(one.value) + interval
                rows.append(what | {"steps": budget, "score": one.value, "low": one.low, "high": one.high})
                rows[-1]["seconds"] = seconds
            cells.append({"task": task, "method": method(name).label, "runs": str(len(tables)), **texts})
    columns = ["task", "method", "runs", *(f"{budget:,.0f} steps" for budget in budgets)]
    shown = pd.DataFrame(cells, columns=columns)
    data = pd.DataFrame(rows, columns=["task", "method", "runs", "steps", "score", "low", "high", "seconds"])
    notes = [
        "Score of the best actions found within a budget of simulated environment steps; steps with and "
        "without gradient count equally. The contact model is hard; for apg, and for adam, gd and adam_h "
        "before their first check, it is that of their rollouts.",
        f"Mean over the variants; {CONFIDENCE:.0%} interval of Student's t from the variances within "
        "variants, none if a variant has one run.",
        "A finished run keeps its score. A method has a score once all of its runs have a row.",
        *settings_note(runs),
    ]
    return [Table("score_at_budget", "ours", "Score at equal budgets", shown, data, notes=notes, long=True)]


# ----------------------------------------------------------------------------------------------------- timing

_TIMES = [
    "Milliseconds per environment step of one environment, mean ± standard deviation (in brackets: number "
    "of measurements). Times of runs exclude building and compiling; the runs of a batch share its time and "
    "count as one measurement. Forward + backward includes measures and update; RL includes simulation, "
    "loss and learning, without evaluations.",
    "The paper used a GTX 1080 Ti. The interval is Student's t over our measurements, because the paper "
    "gives no spread.",
]


def timing(runs: Runs, benchmark: pd.DataFrame | None = None) -> list[Table]:
    """Return times per environment step and task, next to the paper's.

    Args:
        runs: Our runs.
        benchmark: Table of ``plab bench speed --paper --csv``, or None.
    """
    paper = paper_table("timing").set_index("task")
    steps, nothing = _step_times(runs), float("nan")
    measured: list[tuple[str, str, str, Summary, float]] = []
    for task in ordered_tasks(runs.tasks):
        for (device, kind), own in steps[steps["task"] == task].groupby(["device", "kind"]):
            # Runs of one batch share their time and count as one measurement.
            ms = summarise(np.unique(own["ms"].round(9)))
            theirs = paper["forward_backward_ms"].get(task, nothing) if kind == _GRADIENT else nothing
            measured.append((task, kind, f"runs, {device}", ms, theirs))
        for row in () if benchmark is None else benchmark[benchmark["task"] == task].to_dict("records"):
            where = f"benchmark, {row['device']}, {row['precision']}, batch {row['batch']}"
            for kind, column, name in _BENCHMARK:
                measured.append((task, kind, where, summarise([row[column]]), paper[name].get(task, nothing)))
    data, cells = [], []
    for task, kind, where, mine, theirs in measured:
        # The paper gives no standard deviation, so the interval is ours.
        gap, ratio = stratified_difference([mine], [Summary(theirs, 0.0, 2)]), theirs / mine.mean
        which = {"task": task, "measured": where, "what": kind, "measurements": mine.count}
        which |= {"ms": mine.mean, "std": mine.std, "paper_ms": theirs}
        data.append(which | {"difference": gap.value, "low": gap.low, "high": gap.high, "ratio": ratio})
        shown = f"{mean_and_std(mine)} ({mine.count})", number(theirs), number(gap.value, sign=True)
        cells.append((task, kind, where, *shown, format_interval(gap), number(ratio, 1)))
    columns = ["task", "what", "measured by", "plab [ms]", "paper [ms]", "difference", INTERVAL]
    table = pd.DataFrame(cells, columns=[*columns, "paper / plab"])
    numbers = pd.DataFrame(data, columns=None if data else ["task", "measured", "what", "measurements", "ms"])
    notes = [*_TIMES, *origin(benchmark), *settings_note(runs)]
    return [Table("timing", "comparison", "Time per environment step", table, numbers, None, notes, True)]


_GRADIENT = "forward + backward"
_BENCHMARK = ("forward", "forward_ms", "forward_ms"), (_GRADIENT, "gradient_ms", "forward_backward_ms")


def _step_times(runs: Runs) -> pd.DataFrame:
    """Return task, device, kind and milliseconds per environment step of each run."""
    table = runs.table
    if table.empty:
        return pd.DataFrame(columns=["task", "device", "kind", "ms"])
    family, horizon = table["method.family"], table["sim.horizon"].astype(float)
    kind = family.map({"trajectory": _GRADIENT, "rl": "RL"})
    # A run's first iteration counts as compilation.
    steps = np.where(kind == _GRADIENT, table["iterations"] - 1, table["method.episodes"]) * horizon
    optimise = table.get("seconds_optimise", pd.Series(np.nan, table.index))
    ms = 1e3 * optimise / np.where(steps > 0, steps, np.nan)
    device = [
        f"{device}, {batch:.0f} runs at once" if batch > 1 else device
        for device, batch in zip(table["device"], table["batch"], strict=True)
    ]
    return pd.DataFrame({"task": table["task"], "device": device, "kind": kind, "ms": ms}).dropna()


# ------------------------------------------------------------------------------------------ hyper-parameters

RL_METHODS = ("sac", "td3", "ppo")

_GRADIENT_KEYS = {
    "adam": ("softness", "lr", "betas", "eps", "iterations", "action_init"),
    "gd": ("softness", "lr", "momentum", "iterations", "action_init"),
    "adam_h": ("lr", "betas", "eps", "iterations", "action_init"),
}
"""Effective settings by method."""


def hyperparameters() -> list[Table]:
    """Return the settings of all methods, next to the paper's."""
    # Composing needs Hydra.
    from plab.config import load_config

    paper, rows = paper_table("settings").set_index(["method", "key"])["value"], []
    for name in (*RL_METHODS, *_GRADIENT_KEYS):
        shipped = shipped_file("method", name)
        if name in RL_METHODS:
            values, rates = shipped["profiles"]["release"], {}
        else:
            content, rates = load_config([f"method={name}"]).method, shipped["lr_by_task"]["plab"]
            values = {key: getattr(content, key) for key in _GRADIENT_KEYS[name]}
        for key, value in values.items():
            own = rates.items() if key == "lr" else ()
            exceptions = [f"; {_value(rate)} on {task}" for task, rate in own if rate != value]
            ours, theirs = _value(value) + "".join(exceptions), paper.get((name, key), "")
            rows.append({"method": name, "key": key, "plab": ours, "paper": theirs})
    data = pd.DataFrame(rows)
    shown = data.replace("", NOTHING).assign(method=data["method"].map(lambda name: method(name).label))
    bold = np.zeros(shown.shape, dtype=bool)
    bold[:, 2:] = ((data["plab"] != data["paper"]) & data["paper"].ne("")).to_numpy()[:, None]
    notes = [
        "plab: conf/method/, profile release (the authors' code). Paper: profile paper, as printed; for "
        "gradient methods the authors' code, and the paper's decay rate of the soft contact.",
        "Bold: different. Dash: not printed.",
    ]
    title = "Hyper-parameters, compared"
    return [Table("hyperparameters", "comparison", title, shown, data, bold, notes, True)]


def _value(value: Any) -> str:
    """Format a number without unnecessary digits."""
    if isinstance(value, list):
        return f"[{', '.join(_value(item) for item in value)}]"
    if value is None or isinstance(value, bool):
        return str(value).lower()
    try:
        # YAML parses 1e-8 as text.
        number = float(value)
    except ValueError:
        return str(value)
    return str(int(number)) if number.is_integer() else f"{number:g}".replace("e-0", "e-")
