"""Reference numbers: the paper's tables, and benchmark files."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from plab.results import ResultsError


def paper_table(name: str) -> pd.DataFrame:
    """Return one of the paper's tables.

    Args:
        name: ``iou_per_configuration`` (columns task, variant, method, iou_mean, iou_std), ``iou_per_task``
            (the same without variant), ``timing`` (task, forward_ms, forward_backward_ms) or
            ``settings`` (method, key, value). Standard deviations are of the population.
    """
    return pd.read_csv(Path(__file__).parent / f"paper/{name}.csv", comment="#", dtype={"variant": str})


@dataclass(frozen=True)
class Benchmark:
    """A benchmark and its CSV file.

    Attributes:
        file: File name in a folder of benchmarks.
        command: Command that generates the file, with placeholders ``{file}`` and ``{folder}``.
        columns: Required columns.
    """

    file: str
    command: str
    columns: tuple[str, ...]


SPEED = Benchmark(
    "speed.csv",
    "plab bench speed --paper --csv {file}",
    ("task", "device", "precision", "batch", "forward_ms", "gradient_ms"),
)
ACCURACY = Benchmark(
    "accuracy.csv",
    "plab bench accuracy --output {folder}",
    (
        *("axis", "task", "contact", "precision", "material", "substeps", "ms_per_step"),
        *("positions", "gradient", "outcome"),
    ),
)


def read_benchmark(path: Path, benchmark: Benchmark) -> pd.DataFrame:
    """Read a benchmark file; lines that begin with ``#`` describe its origin.

    Raises:
        plab.results.ResultsError: If the file is missing or invalid; the message names the command that
            generates it.
    """
    advice = f"`{benchmark.command.format(file=path, folder=path.parent)}` makes it"
    try:
        content = path.read_bytes()
        table = pd.read_csv(io.BytesIO(content), comment="#")
        table = table[[*benchmark.columns, *table.columns.difference(benchmark.columns)]]
    except FileNotFoundError:
        raise ResultsError(f"there is no {path}: {advice}") from None
    except (OSError, ValueError, KeyError) as error:
        raise ResultsError(f"{path} cannot be read ({error}): {advice}") from error
    lines = content.decode(errors="replace").splitlines()
    said = [line[1:].strip() for line in lines if line.startswith("#")]
    table.attrs["origin"] = [f"Measured: {path}, SHA-256 {hashlib.sha256(content).hexdigest()}", *said]
    return table


def origin(table: pd.DataFrame | None) -> list[str]:
    """Return notes on the source file of a table, if any."""
    return [] if table is None else [f"{line}." for line in table.attrs.get("origin", [])]
