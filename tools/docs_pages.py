"""Generation of site pages, run by mkdocs-gen-files at build time.

The configuration reference is generated from the dataclasses and the YAML files, the Python reference from
docstrings. Files in the repository's root, the suite's tasks and the example notebooks get a page each.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html
import itertools
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
import mkdocs_gen_files
import nbformat
import yaml
from nbclient import NotebookClient

from plab import config
from plab.config.suite import plab_folder
from plab.runners.agents import OffPolicyConfig, RlConfig
from plab.runners.apg import ApgConfig
from plab.runners.planner import PlannerConfig, StagesConfig
from plab.runners.ppo import PpoConfig
from plab.runners.searches import CemConfig, MppiConfig, MultistartConfig, SamplerConfig
from plab.runners.shac import ShacConfig
from plab.runners.td3 import Td3Config
from plab.runners.trajectory import TrajectoryConfig
from plab.targets import RECIPES

ROOT = Path(__file__).parents[1]

PYTHON = {
    "python": (
        "Python",
        "Configurations, problems, scores, and PyTorch.",
        (
            "plab.config",
            "plab.problem",
            "plab.objective",
            "plab.losses",
            "plab.losses.term",
            "plab.envs.autograd",
            "plab.scenes",
            "plab.targets",
        ),
    ),
    "simulator": (
        "Simulator",
        "The simulator, usable without configurations.",
        ("plab.sim.simulator", "plab.sim.tape.RecordedStates", "plab.sim.state"),
    ),
    "methods": (
        "Methods",
        "The interface of a method outside plab.",
        ("plab.config.families", "plab.runners.runner"),
    ),
    "environments": (
        "Environments",
        "",
        (
            "plab.envs.single",
            "plab.envs.vector",
            "plab.envs.sb3",
            "plab.envs.tensors",
            "plab.envs",
            "plab.submissions",
        ),
    ),
    "results": (
        "Results",
        "",
        ("plab.results.run_table", "plab.results.run_file", "plab.demonstrations"),
    ),
}
"""Pages of the reference: title, first line, modules."""

SECTIONS = (
    ("A run", "", config.Config, "config.yaml"),
    ("protocol", "protocol.", config.ProtocolConfig, "protocol/plab.yaml"),
    ("sim", "sim.", config.SimConfig, "sim/fast.yaml"),
    ("targets", "targets.", config.TargetsConfig, "config.yaml:targets"),
    ("method, all", "method.", config.MethodConfig, "method/adam.yaml"),
    ("method=adam, gd, adam_h", "method.", TrajectoryConfig, "method/adam.yaml"),
    ("method=cem, mppi, cmaes, multistart", "method.", PlannerConfig, "method/cem.yaml"),
    ("method=cem, mppi, cmaes", "method.", SamplerConfig, "method/cem.yaml"),
    ("method=cem", "method.", CemConfig, "method/cem.yaml"),
    ("method=mppi", "method.", MppiConfig, "method/mppi.yaml"),
    ("method=multistart", "method.", MultistartConfig, "method/multistart.yaml"),
    ("method=hybrid, solve", "method.", StagesConfig, "method/solve.yaml"),
    ("method=apg", "method.", ApgConfig, "method/apg.yaml"),
    ("method=shac", "method.", ShacConfig, "method/shac.yaml"),
    ("method=sac, td3, ppo", "method.", RlConfig, "method/sac.yaml"),
    ("method=sac, td3", "method.", OffPolicyConfig, "method/sac.yaml"),
    ("method=td3", "method.", Td3Config, "method/td3.yaml"),
    ("method=ppo", "method.", PpoConfig, "method/ppo.yaml"),
    ("task", "task.", config.TaskConfig, "task/Rope.yaml"),
    ("task.bodies.NAME", "task.bodies.NAME.", config.BodyConfig, None),
    ("task.manipulators.NAME", "task.manipulators.NAME.", config.ManipulatorConfig, None),
    ("task.random", "task.random.", config.RandomConfig, None),
    ("task.random.ranges.NAME", "task.random.ranges.NAME.", config.DrawConfig, None),
)
"""Heading, prefix of the keys, type, and file with the defaults, of each table."""

_SHOWN = (bool, int, float, str)


def main() -> None:
    """Write all pages."""
    _write("reference/configuration.md", "\n".join(_configuration()))
    for name, (title, line, modules) in PYTHON.items():
        parts = [
            f"# {title}",
            line,
            *(f"## {module}\n\n::: {module}\n    options: {{heading_level: 3}}" for module in modules),
        ]
        _write(f"reference/{name}.md", "\n\n".join(parts) + "\n")
    for name in ("CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        _write(name.lower(), re.sub(r"\]\(docs/", "](", text))
    for path in (ROOT / "examples" / "notebooks").glob("*.ipynb"):
        _write(f"notebooks/{path.stem}.md", "\n\n".join(_notebook(path)) + "\n")
    for path in (ROOT / "conf" / "task").glob("*.yaml"):
        text = path.read_text(encoding="utf-8")
        _write(f"tasks/{path.stem}.md", f"# {path.stem}\n\n`conf/task/{path.name}`\n\n```yaml\n{text}```\n")


def _notebook(path: Path) -> Iterator[str]:
    """Yield text, code and outputs of a notebook, with links as on the site; 3-D views are files."""
    views = itertools.count(1)
    for cell in _executed(path).cells:
        text = cell.source
        if cell.cell_type == "code":
            yield f"```python\n{text}\n```"
            for output in cell.outputs:
                yield from _output(output, path.stem, views)
        else:
            text = re.sub(r"\]\((\w+)\.ipynb", r"](\1.md", text)
            yield re.sub(r"\]\(\.\./\.\./docs/", "](../", text)
    yield f"Open `examples/notebooks/{path.name}` in Jupyter to run it."


def _executed(path: Path) -> nbformat.NotebookNode:
    """Return a notebook with its outputs, executed in a copy of examples/ and cached in build/ by its
    text."""
    kept = ROOT / "build" / "notebooks" / f"{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}.ipynb"
    if not kept.exists():
        with tempfile.TemporaryDirectory() as folder:
            examples = Path(folder) / "examples"
            ignored = shutil.ignore_patterns("results", "own_conf")
            shutil.copytree(ROOT / "examples", examples, ignore=ignored)
            notebook = nbformat.read(path, as_version=4)
            where = {"metadata": {"path": str(examples / "notebooks")}}
            NotebookClient(notebook, coalesce_streams=True, timeout=None, resources=where).execute()
        kept.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(notebook, kept)
    return nbformat.read(kept, as_version=4)


def _output(output: nbformat.NotebookNode, name: str, views: Iterator[int]) -> Iterator[str]:
    """Yield an output of a cell as Markdown; progress bars (stderr) are omitted."""
    data = output.get("data", {})
    frame = re.search('<iframe .*srcdoc="([^"]*)"', data.get("text/html", ""))
    number = f"{name}-{next(views)}" if frame or "image/png" in data else ""
    if frame:
        _write(f"notebooks/{number}.html", html.unescape(frame[1]))
        yield f'<iframe src="{number}.html" width="100%" height="520" frameborder="0"></iframe>'
    elif "image/png" in data:
        with mkdocs_gen_files.open(f"notebooks/{number}.png", "wb") as file:
            file.write(base64.b64decode(data["image/png"]))
        yield f"![Output of the cell]({number}.png)"
    elif "text/html" in data:
        yield data["text/html"]
    elif text := data.get("text/plain") or (output.text if output.get("name") == "stdout" else ""):
        yield f"```text\n{text.rstrip()}\n```"


def _write(path: str, text: str) -> None:
    with mkdocs_gen_files.open(path, "w") as file:
        file.write(text)


def _configuration() -> Iterator[str]:
    yield "# Configuration\n"
    yield (
        "All keys, with their types and defaults. Defaults are those of `conf/`: for tasks those of Rope, "
        "for values set by a profile those of `release`. "
        "`plab run --help-all` prints the same with the comments of the files.\n"
    )
    for title, prefix, kind, source in SECTIONS:
        yield f"## {title}\n"
        yield _summary(kind) + "\n"
        yield from _table(kind, prefix, _defaults(source))
    yield "## task.target\n"
    yield "`recipe` names one of these; its further keys are the recipe's.\n"
    for name, kind in RECIPES.items():
        yield f"### recipe: {name}\n"
        yield _summary(kind) + "\n"
        yield from _table(kind, "task.target.", {})


def _table(kind: type, prefix: str, defaults: dict[str, Any]) -> Iterator[str]:
    """Yield a table of the keys that a type adds to those of its bases that have their own tables."""
    described = _described(kind)
    known = {field.name for base in kind.__bases__ if _has_table(base) for field in dataclasses.fields(base)}
    yield "| key | type | default | meaning |"
    yield "|---|---|---|---|"
    for field in dataclasses.fields(kind):
        if field.name not in known:
            value = defaults.get(field.name)
            if "${" in str(value) and "profiles" in defaults:
                value = defaults["profiles"][defaults["profile"]].get(field.name)
            plain = isinstance(value, _SHOWN) and "${" not in str(value)
            default = f"`{str(value).lower() if isinstance(value, bool) else value}`" if plain else ""
            if isinstance(value, list) and all(isinstance(entry, _SHOWN) for entry in value):
                default = f"`{value}`"
            shown = str(field.type).replace(" | ", " or ")
            yield f"| `{prefix}{field.name}` | `{shown}` | {default} | {described.get(field.name, '')} |"
    yield ""


def _has_table(kind: type) -> bool:
    return any(kind is other for _, _, other, _ in SECTIONS)


def _defaults(source: str | None) -> dict[str, Any]:
    """Return the values of a file in ``conf/``, or of one of its sections (``file:section``)."""
    if source is None:
        return {}
    name, _, section = source.partition(":")
    content = yaml.safe_load((plab_folder() / name).read_text(encoding="utf-8"))
    return content[section] if section else content


def _described(kind: type) -> dict[str, str]:
    """Return the attribute descriptions from the docstrings of a type and its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        for section in _sections(base):
            if section.kind is griffe.DocstringSectionKind.attributes:
                found |= {item.name: " ".join(item.description.split()) for item in section.value}
    return found


def _summary(kind: type) -> str:
    return next(
        section.value for section in _sections(kind) if section.kind is griffe.DocstringSectionKind.text
    )


def _sections(kind: type) -> list[griffe.DocstringSection]:
    if not kind.__doc__ or kind.__module__ == "builtins":
        return []
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?([^`]+)`", r"`\1`", kind.__doc__)
    text = text.replace("``", "`")
    return griffe.Docstring(text, lineno=1).parse("google", warnings=False)


main()
