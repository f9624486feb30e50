"""Base class of all runners, and the runs of a batch: rows, best actions, times, progress, failures, outcomes
and logs.

A family of methods is a subclass of :class:`Runner`, with hooks for the start of a run, an iteration, and the
state between iterations.
"""

from __future__ import annotations

import gc
import math
import os
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from plab.config import Config, ConfigError
from plab.config.families import SOLVED, family
from plab.errors import TRACEBACK, PlabError, describe_error, out_of_memory, print_error, traceback_wanted
from plab.objective import chamfer_distance, earth_movers_distance
from plab.progress import PLAIN_EVERY, Report, show_progress
from plab.results import ResultsError, RunFile
from plab.results.run_file import BUDGETS, row_count

if TYPE_CHECKING:
    from plab.problem import Episodes, Problem
    from plab.scenes import Scene

Kept = TypeVar("Kept")

FINAL_STATE_COLUMNS = ("iou", "score")
"""Columns that refer to the last state; the others are sums over the steps."""


class RunError(PlabError, RuntimeError):
    """Failed run; the message has iteration and reason."""

    exit_code = 1


class TogetherError(RuntimeError):
    """Runs that cannot be simulated together, because of the error's cause, or because one has failed and the
    others must restart without it."""


def _is_refusal(error: Exception) -> bool:
    """Return True if the user can correct an error: invalid input, or an unusable file."""
    return isinstance(error, PlabError) and error.exit_code == PlabError.exit_code


def _describe(error: Exception) -> str:
    if isinstance(error, PlabError):
        return str(error)
    if isinstance(error, OSError | MemoryError):
        return f"{type(error).__name__}: {error}"
    what, is_bug = describe_error(error)
    return f"a bug: {what}" if is_bug else what


@dataclass(frozen=True)
class Step:
    """Result of an iteration of a run.

    Attributes:
        measures: Measures of the actions: :func:`plab.runners.runner.episode_columns`, and the columns of the
            family. Others are ignored.
        actions: Simulated actions, in [-1, 1], shape [T, A].
        state: State for the next iteration: nested dictionaries of arrays, numbers and strings.
        steps: Environment steps before this iteration; default: those of all episodes simulated so far.
        steps_forward: Environment steps simulated in this iteration without a gradient; default: those of one
            episode.
        steps_gradient: Environment steps simulated in this iteration with a gradient.
        keep: Whether to write the state to the file now, instead of every ``checkpoint_seconds``.
        whole: Whether the actions were simulated to the end; incomplete ones are never the best.
        best: New best actions, possibly of an earlier iteration, with this iteration and its loss; default:
            by the family's ranking.
    """

    measures: Mapping[str, float]
    actions: np.ndarray
    state: Mapping[str, Any]
    steps: int | None = None
    steps_forward: int | None = None
    steps_gradient: int = 0
    keep: bool = False
    whole: bool = True
    best: tuple[np.ndarray, int, float] | None = None


class Track:
    """One run of a batch: configuration, file, index in the batch, progress, and outcome.

    Attributes:
        cfg: Configuration.
        run: File.
        number: Index of the run in its batch, and of its environment in a shared simulator.
        error: Reason of the failure, if any.
        iteration: Number of the next iteration.
        best_loss: Loss of the best actions so far, NaN before the first iteration.
        best_score: Score in their row, if the family ranks by score.
        best_actions: The best actions so far by the family's ranking, shape [T, A]; None before the first
            iteration.
        log: Log of rows and other numbers, selected by ``logger``.
    """

    def __init__(self, cfg: Config, run: RunFile) -> None:
        """Resume a run from its file."""
        self.cfg, self.run, self.number = cfg, run, 0
        self.error: Exception | None = None
        self.finished_before, self.log = run.finished, RunLog(cfg, run)
        result = run.result
        columns, rows = result.columns, result.rows
        self.iteration, self.best_loss, self.best_actions = rows, result.best_loss, result.best_actions
        self._by_score = family(cfg.method.family).ranking == "score"
        known = self._by_score and result.best_iteration >= 0
        self.best_score = float(columns["score"][result.best_iteration]) if known else -np.inf
        self._budget = {name: int(columns[name][-1]) if rows and name in columns else 0 for name in BUDGETS}

    @property
    def open(self) -> bool:
        """Return True if the run has neither finished nor failed."""
        return self.error is None and not self.run.finished

    @property
    def solved(self) -> bool:
        """Return True if the run ranks actions by score and has reached the highest score."""
        return self._by_score and self.best_score >= SOLVED

    def outcome(self) -> Outcome:
        """Return the outcome of the run."""
        if (error := self.error) is None:
            status = "before" if self.finished_before else "finished"
            return Outcome.of(self.cfg, status, self.run.result.score)
        what = _describe(error)
        if not (isinstance(error, PlabError) or traceback_wanted()):
            what += f"; {TRACEBACK}=1 prints the traceback"
        return Outcome.of(self.cfg, "refused" if _is_refusal(error) else "failed", message=what)

    def fail(self, why: str | Exception) -> None:
        """Mark the run as failed because of an error, or a reason in the current iteration. Its file keeps
        the results so far; a run that is rejected before its first iteration leaves no file."""
        self.error = error = RunError(f"iteration {self.iteration}: {why}") if isinstance(why, str) else why
        if isinstance(error, ResultsError) or (_is_refusal(error) and not self.run.advanced):
            # After a ResultsError nothing can be written to the file.
            self.run.discard()
        else:
            try:
                self.run.close("failed", _describe(error))
            except ResultsError as another:
                self.error = another

    @contextmanager
    def results_errors(self) -> Iterator[None]:
        """Mark the run as failed if the block cannot read or write one of its files."""
        try:
            yield
        except ResultsError as error:
            self.fail(error)

    def record(self, step: Step, columns: Sequence[str], seconds: float) -> dict[str, float]:
        """Write an iteration, with the measures of some columns and the run's share of the wall time, to the
        file, and return its row; raise ResultsError if the file cannot be written."""
        horizon, before = len(step.actions), sum(self._budget.values())
        steps = before // horizon * horizon if step.steps is None else step.steps
        forward = horizon if step.steps_forward is None else step.steps_forward
        spent = zip(self._budget.items(), (forward, step.steps_gradient), strict=True)
        self._budget = {name: known + more for (name, known), more in spent}
        row: dict[str, float] = {"iteration": self.iteration, "episodes": steps // horizon, "steps": steps}
        row |= self._budget | {name: step.measures[name] for name in columns}
        row["seconds"] = seconds
        # The first loss replaces NaN, which stands for no loss.
        better = not row["loss"] >= self.best_loss
        # Among equal scores, the lowest loss wins.
        if self._by_score and row["score"] != self.best_score:
            better = row["score"] > self.best_score
        chosen = (step.actions, self.iteration, row["loss"]) if better and step.whole else step.best
        best: dict[str, Any] = {}
        if chosen is not None:
            best = dict(zip(("best_actions", "best_iteration", "best_loss"), chosen, strict=True))
            (self.best_actions, _, self.best_loss), self.best_score = chosen, row["score"]
        # A solved run has no later iteration that would write its state.
        self.run.record(row, step.state, keep=step.keep or self.solved, **best)
        self.log.write({name: row[name] for name in row if name not in ("iteration", "steps")}, steps)
        self.iteration += 1
        return row


def title(*cfgs: Config) -> str:
    """Return task, variant, method and seed of a run, or the task and number of runs of a batch."""
    first, count = cfgs[0], len(cfgs)
    if count > 1:
        return f"{first.task.name}, {count} runs"
    return f"{first.task.name}-v{first.variant} {first.method.name} seed {first.seed}"


_UNFINISHED = {"elsewhere": "running in another process", "lost": "not running"}


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run of a sweep.

    Attributes:
        title: Task, variant, method and seed.
        path: The run's final file.
        status: ``finished``, ``before`` (finished by an earlier process), ``failed``, ``refused`` (invalid
            input), ``elsewhere`` (another process computes it) or ``lost`` (its process has ended).
        score: Score of the final evaluation, NaN if there is none.
        message: One-line reason why the run has not finished.
    """

    title: str
    path: str
    status: str
    score: float = math.nan
    message: str = ""

    @classmethod
    def of(cls, cfg: Config, status: str, score: float = math.nan, message: str = "") -> Outcome:
        """Return the outcome of a configuration's run."""
        return cls(title(cfg), str(cfg.path), status, score, " ".join(message.split()))

    @property
    def finished(self) -> bool:
        """Return whether the result exists."""
        return self.status in ("finished", "before")


def report(outcomes: Sequence[Outcome], runs: int) -> int:
    """Print a summary line of a sweep of some runs, and on standard error one line per reason why runs have
    no result; return the exit code: 0 if all results exist, 2 for invalid input, otherwise 1."""
    count = Counter(one.status for one in outcomes)
    parts = [f"{count['finished']} finished", f"{count['before']} finished before"]
    unfinished = ("failed", "refused", *_UNFINISHED)
    parts += [f"{count[status]} {_UNFINISHED.get(status, status)}" for status in unfinished if count[status]]
    parts += [f"{left} stopped"] if (left := runs - len(outcomes)) else []
    print(f"{runs} runs: {', '.join(parts)}", flush=True)
    titles = defaultdict(list)
    for one in outcomes:
        if not one.finished:
            titles[one.message].append(one.title)
    for message, (first, *others) in titles.items():
        print_error(f"{first}{f' and {len(others)} more' if others else ''}: {message}")
    return 2 if count["refused"] else int(any(not one.finished for one in outcomes))


# -------------------------------------------------------------------------------------------------- runners


class Runner:
    """Base class of runners, which execute a batch of runs and resume them from their files.

    A family defines ``step`` or overrides :meth:`iterate`, and other hooks as needed. Order of calls:
    :meth:`context`, :meth:`build`, :meth:`start` of each run, :meth:`iterate` while any :meth:`has_more`,
    :meth:`conclude` of each run, :meth:`judge`.

    Attributes:
        step: Method that makes one iteration of one run; it raises SimulationError if a state, loss or
            gradient diverges, RunError if it fails for another reason.
        tracks: The runs; a single one if runs cannot share a simulator.
        problem: Problem for evaluating the best actions, with an environment per run; set by :meth:`build`.
        cache: Simulators of earlier runs.
        report: Function of the batch's progress and a short text; see :mod:`plab.progress`.
    """

    step: Callable[[Track], Step]
    problem: Problem
    report: Report

    def __init__(self, tracks: Sequence[Track], note: str, cache: SimulatorCache) -> None:
        """Store the runs, a batch of :func:`plab.sweep.execution.plan`, and a text shown before their
        progress; build nothing yet."""
        self.tracks = list(tracks)
        for number, track in enumerate(tracks):
            track.number = number
        self.cache, self._note = cache, note
        self.report = lambda done, text: None
        self._family = family(tracks[0].cfg.method.family)
        self._phase, self._since, self._timed = "", 0.0, self.tracks

    # ------------------------------------------------------------------------------------------------ hooks

    def build(self) -> None:
        """Check that the runs can be executed, and create their shared objects; by default :attr:`problem`,
        with an environment per run."""
        self.problem = shared_problem(self.cache, [track.cfg for track in self.tracks])

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Create the objects of a run, from a :attr:`Step.state` when resuming."""

    def has_more(self, track: Track) -> bool:
        """Return whether a run has iterations left; by default up to ``method.iterations``."""
        return track.iteration < self.iterations(track)

    def iterations(self, track: Track) -> int:
        """Return the number of a run's iterations."""
        return cast(int, row_count(asdict(track.cfg.method), track.cfg.sim.horizon))

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Make the next iteration of unfinished runs; by default :attr:`step` of each. Yield the successful
        runs; mark failed ones with :meth:`Track.fail`. The wall time is shared equally."""
        for track in tracks:
            yield track, self.step(track)

    def conclude(self, track: Track) -> None:
        """Write additional files of a run, before the final evaluation."""

    def judge(self, actions: np.ndarray) -> Episodes:
        """Simulate the runs' actions, shape [run, T, A], in the hard contact model, in all environments."""
        simulator = self.problem.simulator
        # Iterations may have changed scenes or initial states.
        simulator.set_scenes(self.problem.scenes)
        simulator.set_contact("hard")
        repeated = np.concatenate([actions] * (simulator.batch // len(actions)))
        return self.problem.rollout(repeated, gradient=False, strict=False)

    def context(self) -> AbstractContextManager[Any]:
        """Return a context for the whole batch, such as thread settings of a library."""
        return nullcontext()

    def extent(self) -> tuple[int, int, int]:
        """Return the progress: steps done, total, and interval of reports without a terminal."""
        total = max(self.iterations(track) for track in self.tracks)
        done = [track.iteration for track in self.tracks if track.open and self.has_more(track)]
        return min(done, default=total), total, PLAIN_EVERY

    def summary_line(self, means: Mapping[str, float], tracks: Sequence[Track]) -> str:
        """Return the text of progress after an iteration, given the means of its rows by column."""
        contact = " and ".join(dict.fromkeys(track.cfg.method.contact for track in tracks))
        best = f"loss {np.mean([track.best_loss for track in tracks]):.5g}"
        if self._family.ranking == "score":
            contact = "hard"
            best = f"score {np.mean([t.best_score for t in self.tracks if t.error is None]):.3f}"
        text = f"loss {means['loss']:.5g} {contact} score {means['score']:.3f}"
        # Incomplete episodes of mpc are never the best.
        return text if any(track.best_actions is None for track in tracks) else f"{text} best {best}"

    # ------------------------------------------------------------------------------------ for use in hooks

    @property
    def method(self) -> Any:
        """``method`` section of the first run, shared by runs that train in lockstep."""
        return self.tracks[0].cfg.method

    def enter(self, phase: str, tracks: Sequence[Track] | None = None) -> None:
        """Attribute the wall time from now on to another phase and, if given, to other runs; an empty phase
        is not counted."""
        now = time.perf_counter()
        if self._phase:
            for track in self._timed:
                track.run.add_time(self._phase, (now - self._since) / len(self._timed))
        self._phase, self._since, self._timed = phase, now, list(tracks or self._timed)

    def actions_at_rest(self) -> np.ndarray:
        """Return zero actions for all environments, shape [batch, T, A], for finished runs."""
        scene = self.problem.scenes[0]
        return np.zeros((len(self.tracks), scene.horizon, scene.action_dim))

    # ------------------------------------------------------------------------------- shared implementation

    def run(self) -> None:
        """Execute the runs; a failed run does not affect the others.

        Raises:
            TogetherError: If several runs do not fit into one simulator, but fewer might.
            plab.config.ConfigError: If a required package or device is missing.
            plab.runners.RunError: If a single run cannot be built, or all runs have failed.
        """
        from plab.config.compose import require_runnable
        from plab.sim import DeviceError

        with self.context(), simulation_errors():
            try:
                try:
                    with self._progress(" build"), simulation_errors():
                        self.enter("build")
                        for track in self.tracks:
                            require_runnable(track.cfg)
                        self.build()
                except Exception as error:
                    if len(self.tracks) > 1 and not isinstance(error.__cause__, DeviceError):
                        self._fail_by_kind(error)
                        raise TogetherError(str(error)) from error
                    raise
                for track in self.tracks:
                    self._start(track)
                # The first rollout of a process compiles the kernels.
                phase, columns = "compile", (*episode_columns(self.problem.term_names), *self._family.columns)
                with self._progress("", *self.extent()) as self.report:
                    while active := [track for track in self.tracks if track.open and self.has_more(track)]:
                        self.enter(phase, active)
                        for track in active:
                            # For estimates of the remaining time.
                            track.run.result.provenance["active"] = len(active)
                        phase, start, rows = "optimise", time.perf_counter(), dict[Track, dict[str, float]]()
                        with simulation_errors(f"iteration {active[0].iteration}: "):
                            steps = dict(self.iterate(active))
                        seconds = (time.perf_counter() - start) / len(active)
                        for track, step in steps.items():
                            with track.results_errors():
                                rows[track] = row = track.record(step, columns, seconds)
                        if rows:
                            means = {key: np.mean([own[key] for own in rows.values()]).item() for key in row}
                            text = "mean " * (len(rows) > 1) + self.summary_line(means, list(rows))
                            self.report(self.extent()[0], text)
            finally:
                self.enter("")
            with self._progress(" final evaluation"):
                self._conclude()

    def _progress(
        self, what: str, done: int = 0, total: int | None = None, every: int = PLAIN_EVERY
    ) -> AbstractContextManager[Report]:
        from plab.sim.compiler import watch_compiling

        cfgs = [track.cfg for track in self.tracks]
        options: dict[str, Any] = {"enabled": cfgs[0].progress, "compiling": watch_compiling}
        return show_progress(f"{self._note}{title(*cfgs)}{what}", done, total, plain_every=every, **options)

    def _fail_by_kind(self, error: Exception) -> None:
        """Mark the runs as failed whose configurations caused an error in :meth:`build`, if that is known."""
        from plab.problem import kinds_of

        known = [one.by_kind or {} for one in (error, error.__cause__) if isinstance(one, PlabError)]
        for track, kind in zip(self.tracks, kinds_of([track.cfg for track in self.tracks]), strict=True):
            for own in (errors[kind] for errors in known if kind in errors):
                track.fail(RunError(str(own)) if isinstance(own, RuntimeError) else own)

    def _start(self, track: Track) -> None:
        """Start a run, or resume it from its file; reject a state that does not fit this run."""
        result = track.run.result
        result.labels = self.problem.labels
        if self._family.batching:
            result.provenance["batch"] = len(self.tracks)
        try:
            self.start(track, result.resume)
        except Exception as error:
            if result.resume is None or isinstance(error, PlabError):
                raise
            # Raised by NumPy or torch for a state with other arrays.
            reason, file = " ".join(str(error).split())[:300], track.run.partial_path
            track.fail(ResultsError(f"cannot resume from {file}: {reason}; start again with force=true"))

    def _conclude(self) -> None:
        """Evaluate the best actions in the hard contact model, and finish the files."""
        for track in self.tracks:
            if track.open:
                with track.results_errors():
                    self.conclude(track)
        left = [track for track in self.tracks if track.open]
        if not left:
            return
        best = self.actions_at_rest()
        for track in left:
            best[track.number] = track.best_actions
        self.enter("evaluate", left)
        with simulation_errors("final evaluation: "):
            episodes = self.judge(best)
        self.enter("")
        for track in left:
            number = track.number
            if number in episodes.failures:
                track.fail(RunError(f"final evaluation: {episodes.failures[number]}"))
                continue
            own = self.problem.initial_mass, cast(np.ndarray, episodes.final_mass), self.problem.target_mass
            initial, final, target = (mass[number] for mass in own)
            judged = measures(episodes, number) | {
                "chamfer": chamfer_distance(final, target),
                "earth_movers": earth_movers_distance(final, target),
            }
            with track.results_errors():
                # After the last row, which counts the steps before it.
                steps = int(track.run.result.columns["steps"][-1]) + track.cfg.sim.horizon
                track.log.write({f"final/{name}": judged[name] for name in judged}, steps)
                track.run.finish(judged, {"initial": initial, "final": final, "target": target})


# ----------------------------------------------------------------------------------- simulators and measures


class SimulatorCache:
    """Cache of the last simulator, or an object that holds it, with its key, so that a sweep over seeds
    compiles once."""

    def __init__(self) -> None:
        self._kept: dict[Any, Any] = {}

    def get(self, key: Any, build: Callable[[], Kept], *, check: Callable[[Kept], object]) -> Kept:
        """Return the cached object of the last run if its key is equal and ``check`` does not raise
        RuntimeError (its memory is invalid), otherwise a new object from ``build``."""
        # Other code may have restarted Taichi with another precision or device.
        with suppress(RuntimeError):
            if key in self._kept:
                check(self._kept[key])
                return self._kept[key]
        # Release before building a new one, so that Taichi finds its compiled kernels.
        self.clear()
        self._kept[key] = build()
        return self._kept[key]

    def clear(self) -> None:
        """Release the cached object."""
        if self._kept:
            self._kept.clear()
            gc.collect()


def measures(result: Episodes, environment: int = 0) -> dict[str, float]:
    """Return the scalars of one environment's final evaluation: :func:`episode_columns`, and the IoUs behind
    the scores."""
    sums = zip(result.term_names, result.terms[environment].sum(axis=0), strict=True)
    judged = result.scores[environment]
    return {
        "loss": float(result.loss[environment].sum()),
        **{f"loss_{name}": float(total) for name, total in sums},
        "reward": float(result.reward[environment].sum()),
        "iou": judged.iou_final,
        "score": judged.score,
        "score_printed": judged.score_printed,
        "iou_initial": judged.iou_initial,
        "iou_target_self": judged.iou_target_self,
    }


def episode_columns(term_names: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of an episode's measures, given the loss terms."""
    return ("loss", *(f"loss_{name}" for name in term_names), "reward", *FINAL_STATE_COLUMNS)


def shared_problem(cache: SimulatorCache, cfgs: Sequence[Config]) -> Problem:
    """Return the problem for some configurations, reusing the last simulator if it is compatible."""
    from plab.problem import Problem, build_scenes, make_simulator

    scenes = build_scenes(cfgs)
    key = len(cfgs), simulator_key(cfgs[0], scenes[0])
    kept = cache.get(key, lambda: make_simulator(cfgs, scenes), check=lambda it: it.set_scenes(scenes))
    return Problem(cfgs, kept)


def simulator_key(cfg: Config, scene: Scene) -> Hashable:
    """Return a key that is equal for configurations whose simulators differ only in their scenes."""
    from plab.sim.batch import scene_kind

    sim, method = cfg.sim, cfg.method
    loss = tuple(method.loss_weights.items()), tuple(method.loss_terms.items())
    return scene_kind(scene), loss, sim.precision, sim.device, sim.memory_mb, sim.deterministic


@contextmanager
def simulation_errors(when: str = "") -> Iterator[None]:
    """Convert simulator errors to RunError, and errors about insufficient memory to ConfigError; ``when`` is
    prepended to the message."""
    from plab.sim import DeviceError, SimulationError

    try:
        yield
    except (DeviceError, SimulationError) as error:
        raise RunError(f"{when}{error}") from error
    except MemoryError as error:
        raise ConfigError(f"{when}{out_of_memory(error)}") from error


# ------------------------------------------------------------------------------------------------------- logs


class RunLog:
    """Log of a run beside its file, selected by ``logger`` and opened on first use.

    Each row is logged with the simulated environment steps as its step and the columns of results as names,
    the final evaluation with the prefix ``final/``.
    """

    def __init__(self, cfg: Config, run: RunFile) -> None:
        """Store the run's configuration and file."""
        self._cfg, self._run = cfg, run
        self._write: Callable[[Mapping[str, float], int], object] | None = None
        self._close: Callable[[], object] = lambda: None

    def write(self, values: Mapping[str, float], steps: int) -> None:
        """Log finite numbers by name at an environment step; raise ResultsError on failure."""
        if self._cfg.logger == "none":
            return
        try:
            if self._write is None:
                opened = {"tensorboard": self._tensorboard, "wandb": self._wandb}[self._cfg.logger]
                self._write, self._close = opened(steps)
            self._write({name: float(value) for name, value in values.items() if math.isfinite(value)}, steps)
        except (OSError, RuntimeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ResultsError(f"logger={self._cfg.logger}: {reason}; continue with logger=none") from error

    def close(self) -> None:
        """End the log."""
        # All rows have been written; the final evaluation is in the result file.
        with suppress(OSError, RuntimeError):
            self._close()

    def _tensorboard(self, steps: int) -> tuple[Callable[..., object], Callable[[], object]]:
        """Open a TensorBoard event file in the folder ``<name>.tensorboard`` beside the result; TensorBoard
        hides entries of earlier processes after ``steps``."""
        # Imported here and below, because it is optional.
        from torch.utils.tensorboard.writer import SummaryWriter

        writer = SummaryWriter(str(self._run.path.with_suffix(".tensorboard")), purge_step=steps)

        def write(values: Mapping[str, float], steps: int) -> None:
            for name, value in values.items():
                writer.add_scalar(name, value, steps)
            # Flush, so that entries are visible immediately.
            writer.flush()

        return write, writer.close

    def _wandb(self, _steps: int) -> tuple[Callable[..., object], Callable[[], object]]:
        """Start a run at Weights & Biases, or resume the run of the same configuration. Its files are in the
        folder ``wandb`` of ``results_dir``; ``WANDB_PROJECT``, ``WANDB_MODE`` and other variables apply."""
        import wandb

        cfg = self._cfg
        name = f"{cfg.task.name}-v{cfg.variant}-{cfg.method.name}-{self._run.path.stem}"
        try:
            begun = wandb.init(
                project=os.environ.get("WANDB_PROJECT") or "plab",
                name=name,
                # Ids are limited to 128 characters.
                id=re.sub(r"[^\w.-]", "_", name)[:128],
                dir=cfg.results_dir,
                config=self._run.result.config,
                resume="allow",
                # The runs of a batch are logged side by side.
                reinit="create_new",
                settings=wandb.Settings(silent=True, console="off"),
            )
        except wandb.Error as error:
            raise RuntimeError(f"{error} (WANDB_MODE=offline needs no account)") from error
        begun.define_metric("*", step_metric="steps")
        return lambda values, steps: begun.log({**values, "steps": steps}), begun.finish
