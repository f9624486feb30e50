"""Tables of hyper-parameters, read from ``conf/method/``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import yaml

from plab.config.suite import conf_folder, shipped_file
from plab.report.formats import NOTHING, Table
from plab.report.methods import method
from plab.report.reference import paper_table

RL_METHODS = ("sac", "td3", "ppo")

_GRADIENT_KEYS = {
    "adam": ("softness", "lr", "betas", "eps", "iterations", "action_init"),
    "gd": ("softness", "lr", "momentum", "iterations", "action_init"),
    "adam_h": ("lr", "betas", "eps", "iterations", "action_init"),
}
"""Effective settings by method."""


def hyperparameters() -> list[Table]:
    """Return the settings of all methods: ours, the paper's, and a comparison."""
    data = pd.DataFrame([*_rl_rows(), *_gradient_rows()])
    shown = data.replace("", NOTHING).assign(method=data["method"].map(lambda name: method(name).label))
    ours = shown[["method", "key", "plab", "remark"]].rename(columns={"plab": "value"})
    names = {"paper": "value", "paper remark": "remark"}
    theirs = shown[["method", "key", "paper", "paper remark"]].rename(columns=names)
    both = shown[["method", "key", "plab", "paper"]]
    bold = np.zeros(both.shape, dtype=bool)
    bold[:, 2:] = ((data["plab"] != data["paper"]) & data["paper"].ne("")).to_numpy()[:, None]
    our_note = "As in conf/method/, profile release: the authors' code."
    their_note = (
        "RL methods: conf/method/, profile paper, as far as the paper prints it. Gradient methods: the "
        "authors' code, and the paper's decay rate of the soft contact."
    )
    note = "Bold: not the same. A dash: not printed."
    return [
        Table(
            "hyperparameters", form, f"Hyper-parameters, {whose}", cells, data[columns], bolds, [said], True
        )
        for form, whose, cells, columns, bolds, said in (
            ("ours", "plab", ours, ["method", "key", "plab"], None, our_note),
            ("paper", "the paper", theirs, ["method", "key", "paper"], None, their_note),
            ("comparison", "compared", both, list(data), bold, note),
        )
    ]


def _rl_rows() -> Iterator[dict[str, str]]:
    for name in RL_METHODS:
        text = (conf_folder() / "method" / f"{name}.yaml").read_text(encoding="utf-8")
        profiles = yaml.safe_load(text)["profiles"]
        remarks, printed = _comments(text, "release"), _comments(text, "paper")
        for key, value in profiles["release"].items():
            remark = printed.get(key, "")
            is_printed = "printed" in remark and not remark.startswith("not printed")
            yield {
                "method": name,
                "key": key,
                "plab": _value(value),
                "paper": _value(profiles["paper"][key]) if is_printed else "",
                "remark": remarks.get(key, ""),
                "paper remark": remark,
            }


def _gradient_rows() -> Iterator[dict[str, str]]:
    # Composing needs Hydra.
    from plab.config import load_config

    paper = paper_table("gradient_settings").set_index(["method", "key"])["value"]
    remarks = _comments((conf_folder() / "method" / "adam.yaml").read_text(encoding="utf-8"), None)
    for name, keys in _GRADIENT_KEYS.items():
        content = load_config([f"method={name}"]).method
        for key in keys:
            value = getattr(content, key)
            rates = shipped_file("method", name)["lr_by_task"]["plab"] if key == "lr" else {}
            exceptions = [f"; {_value(rate)} on {task}" for task, rate in rates.items() if rate != value]
            yield {
                "method": name,
                "key": key,
                "plab": _value(value),
                "paper": _value(yaml.safe_load(str(paper[name, key]))),
                "remark": remarks.get(key, "") + "".join(exceptions),
                "paper remark": "",
            }


def _comments(text: str, profile: str | None) -> dict[str, str]:
    """Return the comment on each key of a file, or of one of its profiles."""
    indent = ""
    if profile is not None:
        indent = "    "
        text = re.split(r"\n(?!    )", text.split(f"\n  {profile}:", 1)[1], maxsplit=1)[0]
    return dict(re.findall(rf"^{indent}(\w+):.*?#\s*(.*)", text, re.MULTILINE))


def _value(value: Any) -> str:
    """Format a number without unnecessary digits."""
    if isinstance(value, list):
        return f"[{', '.join(_value(item) for item in value)}]"
    if value is None or isinstance(value, bool):
        return "none" if value is None else str(value).lower()
    try:
        # YAML parses 1e-8 as text.
        number = float(value)
    except ValueError:
        return str(value)
    return str(int(number)) if number.is_integer() else f"{number:g}".replace("e-0", "e-")
