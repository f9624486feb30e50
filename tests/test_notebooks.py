"""Notebooks in examples/: executable, with numbers as in their text. test_docs.py checks the imports."""

from __future__ import annotations

import html
import json
import re
import shutil
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("k3d")

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"


def near(value: float, other: float) -> bool:
    return value != 0.0 and value == pytest.approx(other, rel=1e-3)


# Rounding differs between processors, and descent amplifies it.
NUMBERS = {
    "first_run": {"best actions: (50, 3), score: #": lambda score: score > 0.2},
    "own_task": {"pushed: score #": lambda score: score > 0.1, "solved: score #": lambda score: score > 0.2},
    "own_loss": {
        "{'x': #, 'v': #, 'poses': #}": lambda *errors: max(errors) < 1e-6,
        "mass above the surface, times its height: # -> #": lambda before, after: after < 0.99 * before,
        "norm of the gradient: #, by differences: #": near,
    },
    "differentiable_policy": {
        "loss: # -> #": lambda first, last: last < first - 2.0,
        "norm of the gradient: #, by differences: #": near,
    },
    "identification": {
        "slope: #, by differences: #": near,
        "found #, truth #": lambda found, truth: abs(found - truth) < 0.02 * truth == 1.6,
    },
}


# ----------------------------------------------------------------------------- as Jupyter runs them, nightly


class Outputs:
    """Outputs of a notebook executed in a separate process, in a copy of examples/.

    Attributes:
        text: Printed text and text results, in order.
        views: Content of each viewer: steps, and the score after each step.
    """

    def __init__(self, name: str, folder: Path) -> None:
        shutil.copytree(EXAMPLES, folder / "examples", ignore=shutil.ignore_patterns("results", "own_conf"))
        place = folder / "examples" / "notebooks"
        notebook = nbformat.read(place / f"{name}.ipynb", as_version=4)
        where = {"metadata": {"path": str(place)}}
        nbclient.NotebookClient(notebook, timeout=None, kernel_name="python3", resources=where).execute()
        outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
        data = [output.data for output in outputs if "data" in output]
        printed = [output.text for output in outputs if output.get("name") == "stdout"]
        self.text = "\n".join([*printed, *(one.get("text/plain", "") for one in data)])
        frames = [re.search('<iframe .*srcdoc="([^"]*)"', one.get("text/html", "")) for one in data]
        pages = [html.unescape(frame[1]) for frame in frames if frame]
        self.views = [json.loads(re.search(r"const rollout = (.*);", page)[1]) for page in pages]

    def numbers(self, pattern: str) -> list[float]:
        """Return the numbers in place of ``#`` in a pattern, which must match the text once."""
        number = r"([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
        (found,) = re.findall(re.escape(pattern).replace(r"\#", number), self.text)
        return [float(one) for one in ([found] if isinstance(found, str) else found)]


@pytest.mark.nightly
@pytest.mark.parametrize("name", NUMBERS)
def test_an_executed_notebook(tmp_path, name):
    shown = Outputs(name, tmp_path)
    least = 0.03 if name == "own_loss" else 0.1  # whose loss nearly ignores the target
    assert shown.views and all(view["scores"][-1] > least for view in shown.views)
    for pattern, holds in NUMBERS[name].items():
        assert holds(*shown.numbers(pattern)), pattern
