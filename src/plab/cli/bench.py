"""The command lines of benchmarks: ``python -m plab.bench.speed`` and the others, a function each.

What they measure stands in :mod:`plab.bench`, in modules of the same names. Each is imported where it is run:
what one of them needs, such as torch, would cost the others time and memory.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from plab.cli.arguments import Parser, folder, positive, sources_and_words, task_list, to_write
from plab.cli.command import command_line
from plab.cli.tables import measure_table, print_table, write_csv, write_markdown
from plab.config import ConfigError
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.errors import ArgumentError, pick, tell
from plab.scenes import DEVICES, PRECISIONS

__all__ = [
    "accuracy",
    "main",
    "precision",
    "speed",
    "stability",
    "unseen",
]

HEADING = """\
# Time per environment step

Milliseconds per environment step and environment, measured with `python -m plab.bench.speed --paper`, beside
what the PlasticineLab paper gives for a GTX 1080 Ti, and the paper's divided by ours. The forward pass
includes loss and reward.

"""

LABELLED = 12
"""With more cases than this a figure of norms has no legend: colours repeat."""


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark that the first argument names; return its exit code."""
    names = [name for name in __all__ if name != "main"]
    name, *rest = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(f"plab bench NAME ...: {', '.join(names)}; each has a --help of its own")
        return 0
    if name not in names:
        raise ArgumentError(f"unknown benchmark {name}; {pick(name, names)}")
    return int(globals()[name](rest))


@command_line
def accuracy(argv: Sequence[str] | None = None) -> None:
    """Compare settings with references, print, write the table and the diagrams."""
    import pandas as pd

    from plab.bench import accuracy as bench
    from plab.report.costs import diagrams
    from plab.report.figures import save, style

    parser = Parser("plab.bench.accuracy", bench.__doc__)
    parser.add_argument("--quick", action="store_true", help="coarser, fewer settings, 20 steps")
    what = f"tasks, with commas between (all; {','.join(bench.QUICK_TASKS)} with --quick)"
    parser.add_argument("--task", type=task_list, help=what)
    what = "particles per environment (10000; 1000 with --quick)"
    parser.add_argument("--particles", type=positive, help=what)
    parser.add_argument("--device", choices=DEVICES, default="cpu", help="cpu or cuda")
    parser.add_argument("--output", type=folder, default=Path("accuracy"), help="folder of what is written")
    options = parser.parse_intermixed_args(argv)
    tasks = options.task or (bench.QUICK_TASKS if options.quick else bench.TASKS)
    if unknown := set(tasks) - set(bench.TASKS):
        parser.error(f"no diagrams for {', '.join(sorted(unknown))}; choose from: {', '.join(bench.TASKS)}")
    plan = bench.QUICK if options.quick else bench.Plan()
    plan = replace(plan, particles=options.particles or plan.particles, device=options.device)
    output = options.output
    output.mkdir(parents=True, exist_ok=True)
    table = measure_table(bench.COLUMNS, bench.rows(tasks, plan), output / "accuracy.csv")
    with style():
        drawings = diagrams(pd.DataFrame(table))
    save(drawings, output, {"footer": ["python -m plab.bench.accuracy"]})
    for drawing in drawings:
        print(output / f"{drawing.name}.png", output / f"{drawing.name}.pdf", sep="\n")


@command_line
def precision(argv: Sequence[str] | None = None) -> None:
    """Compare float32 with float64, print, write the files asked for."""
    import pandas as pd

    from plab.bench import precision as bench
    from plab.report.costs import precision_summary

    parser = Parser("plab.bench.precision", bench.__doc__)
    parser.add_argument("--task", type=task_list, default=suite_tasks(), help="tasks, with commas between")
    parser.add_argument("--variant", nargs="+", default=list(SUITE_VARIANTS), help="variants")
    parser.add_argument("--particles", type=positive, default=1000, help="particles per environment")
    parser.add_argument("--device", choices=DEVICES, default="cpu", help="cpu or cuda")
    parser.add_argument("--deterministic", action="store_true", help="sums of integers in float32, on CUDA")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    parser.add_argument("--markdown", type=to_write, help="file to write a table to, a row per task")
    options = parser.parse_intermixed_args(argv)
    configurations = bench.starts(options.task, options.variant, options.particles)
    rows = bench.compare(configurations, options.device, options.deterministic)
    table = measure_table(bench.COLUMNS, rows, options.csv)
    if options.markdown is not None:
        worst = precision_summary(pd.DataFrame(table))
        heading = f"float32 against float64, {options.particles} particles, 50 steps.\n\n"
        write_markdown(options.markdown, heading, list(worst.columns), worst.to_dict("records"))


@command_line
def speed(argv: Sequence[str] | None = None) -> int:
    """Time environment steps, print, write the files asked for; return the exit code: 1 if a skip changes
    results or a row needs too much memory."""
    options = _speed_options(argv)
    refused: list[str] = []
    columns, rows, widths = _speed_rows(options, refused)
    table = measure_table(columns, rows, options.csv, widths)
    if options.paper and options.markdown is not None:
        write_markdown(options.markdown, HEADING, columns, table)
    for line in refused:
        tell(f"not measured: {line}")
    broken = [str(row["skip"]) for row in table if not row.get("equal", True)]
    if broken:
        cuda = table[0]["device"] == "cuda" and table[0]["precision"] == "float32"
        again = "; sums on CUDA vary from run to run: see whether --precision float64 says so, too"
        tell(f"results differ by more than rounding: {', '.join(broken)}{again if cuda else ''}")
    return 1 if refused or broken else 0


def _speed_options(argv: Sequence[str] | None) -> argparse.Namespace:
    from plab.bench import speed as bench
    from plab.bench.workload import KINDS

    parser = Parser("plab.bench.speed", bench.__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration overrides: task=Move sim.device=cuda")
    parser.add_argument("--task", type=task_list, help="tasks, such as Move,Rope; with --paper all ten")
    parser.add_argument("--device", help="the same as sim.device=...")
    parser.add_argument("--precision", nargs="+", help="precisions, one after the other")
    parser.add_argument("--batch", type=positive, nargs="+", default=[1], help="numbers of environments")
    parser.add_argument("--steps", type=positive, help="environment steps per rollout")
    parser.add_argument("--repeats", type=positive, help="timed rollouts")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), help="what is timed")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    parser.add_argument("--markdown", type=to_write, help="file to write the paper's table to")
    parser.add_argument("--quick", action="store_true", help="fewer rows, steps and repeats")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--scaling", action="store_true", help="rows for numbers of particles and grids")
    modes.add_argument("--paper", action="store_true", help="the paper's table beside ours")
    modes.add_argument("--limits", action="store_true", help="how fast the machine copies memory")
    parser.add_argument("--particles", type=positive, nargs="+", help="--scaling: numbers of particles")
    parser.add_argument("--grids", type=positive, nargs="+", help="--scaling: nodes per axis")
    options = parser.parse_intermixed_args(argv)
    if options.device:
        options.overrides = [*options.overrides, f"sim.device={options.device}"]
    given = [override.partition("=")[0] for override in options.overrides]
    if not options.task and "task" not in given:
        options.task = list(suite_tasks()) if options.paper else ["Move"]
    quick = options.quick
    options.steps = options.steps or (5 if quick else 10)
    options.repeats = options.repeats or (3 if quick else 7)
    options.kinds = options.kinds or (bench.QUICK_KINDS if quick else tuple(KINDS))
    options.particles = options.particles or bench.PARTICLES[: 2 if quick else None]
    options.grids = options.grids or bench.GRIDS[: 2 if quick else None]
    return options


def _speed_rows(
    options: argparse.Namespace, refused: list[str]
) -> tuple[Sequence[str], Iterable[Mapping[str, object]], Mapping[str, int] | None]:
    """Return names of columns, the rows, which are measured when they are asked for, and widths of columns.
    For what needs more memory than there may be a line is added to ``refused``."""
    from plab.bench import speed as bench
    from plab.bench import workload

    # Columns whose entries are not as long as most.
    wide = {"what": max(map(len, workload.KINDS)), "device": 6, "batch": 5}
    steps, repeats, quick = options.steps, options.repeats, options.quick
    tasks = [[f"task={name}"] for name in options.task or ()] or [[]]
    precisions = [[f"sim.precision={name}"] for name in options.precision or ()] or [[]]
    chosen = [[*options.overrides, *precision] for precision in precisions]
    first = chosen[0]
    if options.limits:
        return bench.LIMIT_COLUMNS, bench.limit_rows(options.overrides), None
    if options.scaling:
        kinds = bench.QUICK_KINDS[:1] if quick else bench.QUICK_KINDS
        sizes = itertools.product(options.grids, options.particles)
        each = (bench.scaling_rows([*first, *tasks[0]], size, kinds, repeats) for size in sizes)
        return bench.SCALING_COLUMNS, itertools.chain.from_iterable(each), wide
    if options.paper:
        cells = itertools.product(options.batch, options.task)
        rows = (bench.paper_row(task, first, batch, steps, repeats) for batch, task in cells)
        return bench.PAPER_COLUMNS, rows, {"task": 10}
    how = (steps, repeats, options.kinds)
    each = (bench.all_rows(words, tasks, options.batch, how, refused) for words in chosen)
    return bench.COLUMNS, itertools.chain.from_iterable(each), wide


@command_line
def stability(argv: Sequence[str] | None = None) -> int:
    """Simulate what breaks simulators, print, write the files asked for; return the exit code."""
    from plab.bench import stability as bench
    from plab.bench.stress_cases import stress_cases

    parser = Parser("plab.bench.stability", bench.__doc__)
    parser.add_argument("--quick", action="store_true", help="one variant of each task, fewer particles")
    parser.add_argument("--precision", choices=PRECISIONS, nargs="+", default=list(PRECISIONS))
    parser.add_argument("--particles", type=positive, help="particles per environment (300; 64 with --quick)")
    parser.add_argument("--horizon", type=positive, help="environment steps of the long horizon (1000)")
    parser.add_argument("--family", nargs="+", help="only these families of cases")
    parser.add_argument("--csv", type=to_write, help="file to write a row per case to")
    what = "file for the gradient's norm per step back in time"
    parser.add_argument("--gradients", type=to_write, help=what)
    options = parser.parse_intermixed_args(argv)
    plan = bench.QUICK if options.quick else bench.FULL
    plan = replace(plan, particles=options.particles or plan.particles)
    plan = replace(plan, long_horizon=options.horizon or plan.long_horizon)
    cases = stress_cases(plan)
    families = list(dict.fromkeys([*(case.family for case in cases), bench.REFUSAL]))
    if unknown := set(options.family or ()) - set(families):
        raise ConfigError(f"no cases of {', '.join(sorted(unknown))}; choose from: {', '.join(families)}")
    chosen = options.family or families
    cases = [case for case in cases if case.family in chosen]
    each = [bench.run_cases(cases, precision) for precision in options.precision]
    refused = bench.run_refusals() if bench.REFUSAL in chosen else ()
    table = measure_table(bench.COLUMNS, itertools.chain(*each, refused), options.csv)
    if options.gradients is not None:
        _write_norms(table, options.gradients)
    return _summarise(table)


def _write_norms(rows: Sequence[Mapping[str, object]], path: Path) -> None:
    """Write, and draw, the norm of the gradient for each step back in time.

    Args:
        rows: What :func:`plab.bench.stability.run_cases` yields; others are left out.
        path: CSV file; the drawing is a PNG of the same name.
    """
    from plab.report.figures import legend, log_axis, single, style

    parts = [
        (row["precision"], row["family"], row["case"], norms[::-1])
        for row in rows
        if (norms := cast("np.ndarray | None", row.get("norms"))) is not None
    ]
    if not parts:
        tell("no case has a gradient")
        return
    table = [(*which, back, norm) for *which, norms in parts for back, norm in enumerate(norms)]
    write_csv(path, [("precision", "family", "case", "back", "norm"), *table], digits=6)
    with style():
        figure, panel = single(7.0, 4.0)
        colours: dict[str, str] = {}
        for precision, _family, case, norms in parts:
            label = None if case in colours else str(case)
            colour = colours.setdefault(str(case), f"C{len(colours) % 10}")
            # Steps that nothing depends on have no place on a log scale.
            norms = np.where(norms > 0, norms, np.nan)
            panel.plot(norms, "-" if precision == "float32" else ":", color=colour, label=label)
        panel.set_xlabel("environment steps back from the end")
        panel.set_title("solid: float32, dotted: float64", loc="right")
        log_axis(panel, "norm of a step's gradient", vertical=True)
        if len(colours) <= LABELLED:
            legend(figure, columns=3)
        figure.savefig(path.with_suffix(".png"))
    print(path.with_suffix(".png"))


def _summarise(rows: Sequence[Mapping[str, object]]) -> int:
    """Print how many cases of each family survived; return the exit code."""
    import pandas as pd

    table = pd.DataFrame(rows)
    table["survived"] = table["outcome"].isin(["survived", "refused"])
    groups = table.groupby(["precision", "family"], sort=False, as_index=False)["survived"]
    counts = groups.agg(["size", "sum"]).itertuples(index=False, name=None)
    total = ("", "all", len(table), table["survived"].sum())
    print()
    print_table(("precision", "family", "cases", "survived"), [*counts, total])
    return 0 if table["survived"].all() else 1


@command_line
def unseen(argv: Sequence[str] | None = None) -> None:
    """Try policies in scenes that they have not seen, print, write a CSV file if asked to."""
    from plab.bench import unseen as bench

    parser = Parser("plab.bench.unseen", bench.__doc__)
    parser.add_argument("what", nargs="+", metavar="RESULT | KEY=VALUE", help="keys are those of plab.run")
    parser.add_argument("--scenes", type=positive, default=100, metavar="N", help="so many scenes")
    parser.add_argument("--together", type=positive, default=25, metavar="N", help="simulated at a time")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    paths, words = sources_and_words(options.what)
    if not paths:
        parser.error("name the result file of a run that has trained a policy")
    if options.scenes < 2:
        parser.error("--scenes has to be at least 2: one score has no interval")
    widths = {"policy": max(map(len, paths)), "trained_on": 17}
    rows = bench.rows(paths, options.scenes, options.together, words)
    measure_table(bench.COLUMNS, rows, options.csv, widths)
