"""The tables of hyper-parameters, read from ``conf/method/``."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import yaml

from plab.config.suite import conf_folder, shipped_file
from plab.report.methods import method
from plab.report.reference import paper_table
from plab.report.table import NOTHING, Table

__all__ = ["hyperparameters"]

RL_METHODS = ("sac", "td3", "ppo")
GRADIENT_METHODS = ("adam", "gd", "adam_h")

_GRADIENT_KEYS = {
    "adam": ("softness", "lr", "betas", "eps", "iterations", "action_init"),
    "gd": ("softness", "lr", "momentum", "iterations", "action_init"),
    "adam_h": ("lr", "betas", "eps", "iterations", "action_init"),
}
"""Settings by method that have an effect on it."""

_PRINTED = re.compile(r"printed")
_NOT_PRINTED = re.compile(r"not printed")


def hyperparameters() -> list[Table]:
    """Return the settings of all methods: ours, the paper's, and the two compared."""
    rows = [*_rl_rows(), *_gradient_rows()]
    data = pd.DataFrame(rows)
    differs = (data["plab"] != data["paper"]) & data["paper"].ne("")
    notes = {
        "ours": ["As in conf/method/, profile release: the authors' code."],
        "paper": [
            "RL methods: conf/method/, profile paper, as far as the paper prints it. Gradient methods: the "
            "authors' code, and the paper's decay rate of the soft contact."
        ],
        "comparison": ["Bold: not the same. A dash: not printed."],
    }
    shown = data.replace("", NOTHING).assign(method=data["method"].map(lambda name: method(name).label))
    ours = shown[["method", "key", "plab", "remark"]].rename(columns={"plab": "value"})
    theirs = shown[["method", "key", "paper", "paper remark"]].rename(
        columns={"paper": "value", "paper remark": "remark"}
    )
    both = shown[["method", "key", "plab", "paper"]]
    bold = np.zeros(both.shape, dtype=bool)
    bold[:, 2:] = differs.to_numpy()[:, None]
    forms = (
        ("ours", "plab", ours, ["method", "key", "plab"], None),
        ("paper", "the paper", theirs, ["method", "key", "paper"], None),
        ("comparison", "compared", both, list(data), bold),
    )
    return [
        Table(
            "hyperparameters",
            form,
            f"Hyper-parameters, {whose}",
            cells,
            data[columns],
            bolds,
            notes[form],
            True,
        )
        for form, whose, cells, columns, bolds in forms
    ]


def _rl_rows() -> Iterator[dict[str, str]]:
    for name in RL_METHODS:
        text = _text(name)
        content = yaml.safe_load(text)
        ours, theirs = content["profiles"]["release"], content["profiles"]["paper"]
        remarks, printed = _comments(text, "release"), _comments(text, "paper")
        for key in ours:
            said = _PRINTED.search(printed.get(key, "")) and not _NOT_PRINTED.match(printed.get(key, ""))
            yield {
                "method": name,
                "key": key,
                "plab": _value(ours[key]),
                "paper": _value(theirs[key]) if said else "",
                "remark": remarks.get(key, ""),
                "paper remark": printed.get(key, ""),
            }


def _gradient_rows() -> Iterator[dict[str, str]]:
    # Imported here: composing needs Hydra.
    from plab.config import load_config

    paper = paper_table("gradient_settings").set_index(["method", "key"])["value"]
    for name in GRADIENT_METHODS:
        content = load_config([f"method={name}"]).method
        for key in _GRADIENT_KEYS[name]:
            theirs = yaml.safe_load(str(paper[name, key]))
            yield {
                "method": name,
                "key": key,
                "plab": _value(getattr(content, key)),
                "paper": _value(theirs),
                "remark": _comments(_text("adam"), None).get(key, "")
                + _exceptions(name, key, getattr(content, key)),
                "paper remark": "",
            }


def _exceptions(name: str, key: str, general: Any) -> str:
    """Return what the remark on a key has to say of the tasks that have another value."""
    rates = shipped_file("method", name)["lr_by_task"]["plab"] if key == "lr" else {}
    return "".join(f"; {_value(rate)} on {task}" for task, rate in rates.items() if rate != general)


@functools.cache
def _text(name: str) -> str:
    return (conf_folder() / "method" / f"{name}.yaml").read_text(encoding="utf-8")


def _comments(text: str, profile: str | None) -> dict[str, str]:
    """Return the comment on each key of a file, or of one of its profiles."""
    lines = text.splitlines()
    indent = "" if profile is None else "    "
    if profile is not None:
        start = lines.index(next(line for line in lines if line.startswith(f"  {profile}:"))) + 1
        end = next((k for k in range(start, len(lines)) if not lines[k].startswith(indent)), len(lines))
        lines = lines[start:end]
    matches = (re.match(rf"{indent}(\w+):.*?#\s*(.*)", line) for line in lines)
    return {found[1]: found[2] for found in matches if found}


def _value(value: Any) -> str:
    """Write a number without needless digits, whatever form YAML had it in."""
    if isinstance(value, list):
        return f"[{', '.join(_value(item) for item in value)}]"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    try:
        # YAML reads 1e-8 as text.
        number = float(value)
    except ValueError:
        return str(value)
    return str(int(number)) if number.is_integer() else f"{number:g}".replace("e-0", "e-")
