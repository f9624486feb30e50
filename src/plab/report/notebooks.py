"""Execution of the report notebooks, and conversion to HTML."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from plab.config.suite import plab_folder
from plab.progress import Report
from plab.report.page import asset, render
from plab.results import ResultsError
from plab.results.run_file import replace_file

NOTEBOOKS = ("reproduction", "speed", "accuracy", "anatomy")
"""Names of the notebooks."""

_PACKAGES = ("jupytext", "nbclient", "nbconvert", "nbformat", "ipykernel", "IPython")


def execute(parameters: Mapping[str, Any], out: Path, report: Report) -> None:
    """Execute all notebooks, and write each as HTML and as a notebook with outputs.

    Args:
        parameters: Values for the names in the ``parameters`` cell of the notebooks.
        out: Folder to write to.
        report: Callback with the number of finished notebooks, and the name of the last one.

    Raises:
        plab.results.ResultsError: If a package is missing, or a notebook fails.
    """
    if missing := [name for name in _PACKAGES if find_spec(name) is None]:
        what = f"{', '.join(missing)}, not installed here: pip install 'plab[report]'"
        raise ResultsError(f"notebooks need {what}")
    import nbformat
    from nbconvert import HTMLExporter

    for number, name in enumerate(NOTEBOOKS, start=1):
        notebook = _executed(name, parameters)
        exporter = HTMLExporter(template_name="basic", exclude_input_prompt=True, exclude_output_prompt=True)
        html = render(
            "notebook.html",
            style=asset("page.css") + asset("notebook.css"),
            script=asset("theme.js"),
            body=exporter.from_notebook_node(notebook)[0],
            name=name,
            names=NOTEBOOKS,
        )
        replace_file(out / f"{name}.ipynb", nbformat.writes(notebook))
        replace_file(out / f"{name}.html", html)
        report(number, name)


def _executed(name: str, parameters: Mapping[str, Any]) -> Any:
    import jupytext
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    notebook = jupytext.read(plab_folder("reports") / f"{name}.py")
    at = next(k for k, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", []))
    given = "\n".join(f"{key} = {value!r}" for key, value in parameters.items())
    notebook.cells.insert(at + 1, nbformat.v4.new_code_cell(f"# Given on the command line\n{given}"))
    client = NotebookClient(notebook, timeout=None, kernel_name="python3")
    try:
        # Output of the kernel process concerns Jupyter; output of cells is in the notebook.
        client.execute(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except CellExecutionError as error:
        raise ResultsError(f"notebook {name} failed: {error.ename}: {error.evalue}") from error
    for cell in notebook.cells:
        if cell.cell_type == "code":
            # Results are displayed explicitly; printed text comes from libraries.
            cell.outputs = [output for output in cell.outputs if output.output_type != "stream"]
    return notebook
