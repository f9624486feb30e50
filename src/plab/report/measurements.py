"""Files of the benchmarks, which some tables and figures show beside the runs."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from plab.files import regular_file
from plab.results import ResultsError

__all__ = ["ACCURACY", "PRECISION", "SPEED", "Benchmark", "measured", "origin"]


@dataclass(frozen=True)
class Benchmark:
    """A benchmark whose file is read.

    Attributes:
        file: Name that its file has in a folder of benchmarks.
        command: Command that writes it, with ``{file}`` and ``{folder}`` for where.
        columns: Columns that are needed.
    """

    file: str
    command: str
    columns: tuple[str, ...]

    def maker(self, path: Path) -> str:
        """Return the command that writes a file."""
        return self.command.format(file=path, folder=path.parent)


SPEED = Benchmark(
    "speed.csv",
    "python -m plab.bench.speed --paper --csv {file}",
    ("task", "device", "batch", "forward_ms", "gradient_ms"),
)
ACCURACY = Benchmark(
    "accuracy.csv",
    "python -m plab.bench.accuracy --output {folder}",
    (
        *("axis", "task", "contact", "precision", "material", "substeps", "ms_per_step"),
        *("positions", "gradient", "outcome"),
    ),
)
PRECISION = Benchmark(
    "precision.csv",
    "python benchmarks/precision.py --csv {file}",
    ("task", "actions", "difference", "angle_deg", "failures"),
)


def measured(path: Path, benchmark: Benchmark) -> pd.DataFrame:
    """Read a benchmark's file; lines that begin with ``#`` say how it was made.

    Raises:
        plab.results.ResultsError: If it is missing or not what it should be; the message says what makes it.
    """
    advice = f"`{benchmark.maker(path)}` makes it"
    try:
        regular_file(path)
        content = path.read_bytes()
        table = pd.read_csv(io.BytesIO(content), comment="#")
    except FileNotFoundError:
        raise ResultsError(f"there is no {path}: {advice}") from None
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path} cannot be read ({error}): {advice}") from error
    if missing := [name for name in benchmark.columns if name not in table]:
        raise ResultsError(f"{path} lacks {', '.join(missing)}: {advice}")
    if table.empty:
        raise ResultsError(f"{path} has no rows: {advice}")
    lines = content.decode(errors="replace").splitlines()
    said = [line[1:].strip() for line in lines if line.startswith("#")]
    table.attrs["origin"] = [f"Measured: {path}, SHA-256 {hashlib.sha256(content).hexdigest()}", *said]
    return table


def origin(table: pd.DataFrame | None) -> list[str]:
    """Return sentences on the file that a table was read from; none where it was not."""
    return [] if table is None else [f"{line}." for line in table.attrs.get("origin", [])]
