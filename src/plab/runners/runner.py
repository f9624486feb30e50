"""Base of all runners: files, rows, best actions, wall times, progress, failures and the final evaluation.

A family of methods is a subclass of :class:`Runner`, with hooks for the start of a run, an iteration, and the
state between iterations.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from plab.config import Config, ConfigError
from plab.config.families import family
from plab.errors import PlabError, out_of_memory
from plab.objective import chamfer_distance, earth_movers_distance
from plab.progress import PLAIN_EVERY, Report, show_progress
from plab.results import ResultsError, row_count
from plab.runners.tracks import RunError, Step, TogetherError, Track, title

if TYPE_CHECKING:
    from plab.problem import Episodes, Problem
    from plab.scenes import Scene

Kept = TypeVar("Kept")

COLUMNS = ("loss", "reward", "iou", "score")
"""Columns of the results common to all methods: measures of an episode besides the loss terms."""

FINAL_STATE_COLUMNS = ("iou", "score")
"""Columns that refer to the last state; the others are sums over the steps."""


class Runner:
    """Base of runners, which execute a batch of runs, resuming from their files.

    A family overrides :meth:`build`, :meth:`step` or :meth:`iterate`, and other hooks as needed. Order of
    calls: :meth:`context`, :meth:`build`, :meth:`start` of each run, :meth:`iterate` while any
    :meth:`has_more`, :meth:`close`, :meth:`conclude` of each run, :meth:`judge`.

    Attributes:
        tracks: The runs; a single one if runs cannot share a simulator.
        problem: Problem for evaluating the best actions, with an environment per run; set by :meth:`build`.
        cache: Simulators of earlier runs.
        report: Function of the batch's progress and a short text; see :mod:`plab.progress`.
    """

    problem: Problem
    report: Report

    def __init__(self, tracks: Sequence[Track], note: str, cache: SimulatorCache) -> None:
        """Take over some runs, as alike as :func:`plab.sweep.running.plan` asks for, with a text before their
        progress; nothing is built yet."""
        self.tracks = list(tracks)
        for number, track in enumerate(tracks):
            track.number = number
        self.cache, self._note = cache, note
        self._family = family(tracks[0].cfg.method.family)
        self._phase, self._since, self._timed = "", 0.0, self.tracks

    # ------------------------------------------------------------------------------------------------ hooks

    def build(self) -> None:
        """Check that the runs are possible, then create their shared objects, at least :attr:`problem`."""
        raise NotImplementedError(f"{type(self).__name__} needs build")

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Create the objects of a run, from a :attr:`Step.state` when resuming."""

    def has_more(self, track: Track) -> bool:
        """Return whether a run has iterations left; by default up to ``method.iterations``."""
        return track.iteration < self.iterations(track)

    def iterations(self, track: Track) -> int:
        """Return the number of a run's iterations."""
        return cast(int, row_count(asdict(track.cfg.method)))

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Make the next iteration of unfinished runs; by default :meth:`step` of each. Yield the successful
        ones; mark failed ones with :meth:`Track.fail`."""
        for track in tracks:
            yield track, self.step(track)

    def step(self, track: Track) -> Step:
        """Make one iteration of one run; SimulationError if a state, loss or gradient diverges, RunError if
        it fails for another reason."""
        raise NotImplementedError(f"{type(self).__name__} needs step or iterate")

    def close(self) -> None:
        """Release the objects of the iterations, also after a failure."""

    def conclude(self, track: Track) -> None:
        """Write additional files of a run, before the final evaluation."""

    def judge(self, actions: np.ndarray) -> Episodes:
        """Run actions, shape [batch, T, A], in the hard contact model."""
        self.problem.simulator.set_contact("hard")
        return self.problem.rollout(actions, gradient=False, strict=False)

    def context(self) -> AbstractContextManager[Any]:
        """Return a context for the whole batch, such as the threads of a library."""
        return nullcontext()

    def extent(self) -> tuple[int, int, int]:
        """Return the progress: count done, total, and interval of reports without a terminal."""
        total = max(self.iterations(track) for track in self.tracks)
        return min(track.iteration for track in self.tracks), total, PLAIN_EVERY

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Report loss and score after an iteration, of several runs on average."""
        loss, score = (np.mean([row[name] for row in rows]) for name in ("loss", "score"))
        best = np.mean([track.best_loss for track in tracks])
        contact = " and ".join(dict.fromkeys(track.contact for track in tracks))
        mean = "" if len(rows) == 1 else "mean "
        text = f"{mean}loss {loss:.5g} {contact} score {score:.3f} best {best:.5g}"
        self.report(min(track.iteration for track in tracks), text)

    # ------------------------------------------------------------------------------------ for use in hooks

    @property
    def method(self) -> Any:
        """The section ``method`` of the first run, which those that train in step have in common."""
        return self.tracks[0].cfg.method

    def enter(self, phase: str, tracks: Sequence[Track] | None = None) -> None:
        """Attribute the wall time from now on to another phase, and to other runs if given; an empty phase is
        not counted."""
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

        with self.context(), simulation_errors(), ExitStack() as logs:
            for track in self.tracks:
                logs.callback(track.log.close)
            try:
                try:
                    with self._progress(" build"), simulation_errors():
                        self.enter("build")
                        for track in self.tracks:
                            require_runnable(track.cfg)
                        self.build()
                except Exception as error:
                    if len(self.tracks) > 1 and not isinstance(error.__cause__, DeviceError):
                        raise TogetherError(str(error)) from error
                    raise
                for track in self.tracks:
                    self._start(track)
                with self._progress("", *self.extent()) as self.report:
                    self._iterate_all()
            finally:
                self.enter("")
                self.close()
            with self._progress(" final evaluation"):
                self._conclude()

    def _progress(
        self, what: str, done: int = 0, total: int | None = None, every: int = PLAIN_EVERY
    ) -> AbstractContextManager[Report]:
        from plab.sim.compiler import watch_compiling

        cfgs = [track.cfg for track in self.tracks]
        options: dict[str, Any] = {"enabled": cfgs[0].progress, "compiling": watch_compiling}
        return show_progress(f"{self._note}{title(*cfgs)}{what}", done, total, plain_every=every, **options)

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
            # Of NumPy or torch, at a state of other arrays.
            reason, file = " ".join(str(error).split())[:300], track.run.partial_path
            track.fail(ResultsError(f"{file} cannot be gone on from: {reason}; start afresh with force=true"))

    def _iterate_all(self) -> None:
        # The first rollout of a process compiles the kernels.
        phase, columns = "compile", (*episode_columns(self.problem.term_names), *self._family.columns)
        while active := [track for track in self.tracks if track.open and self.has_more(track)]:
            self.enter(phase, active)
            rows, start = [], time.perf_counter()
            with simulation_errors(f"iteration {active[0].iteration}: "):
                for track, step in self.iterate(active):
                    if step.seconds is None:
                        step = replace(step, seconds=time.perf_counter() - start)
                    with track.results_errors():
                        rows.append(track.record(step, columns))
                    start = time.perf_counter()
            phase = "optimise"
            if rows:
                self.tell(rows, active)

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
        RuntimeError (its memory is invalid); otherwise a new one from ``build``."""
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
    """Return the scalars of the final evaluation of one environment: those of :func:`episode_columns`, and
    the IoUs behind the scores."""
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
    first, *rest = COLUMNS
    return (first, *(f"loss_{name}" for name in term_names), *rest)


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
    """Convert errors of the simulator into RunError, and those about insufficient memory into ConfigError;
    ``when`` is prepended to the message."""
    from plab.sim import DeviceError, SimulationError

    try:
        yield
    except (DeviceError, SimulationError) as error:
        raise RunError(f"{when}{error}") from error
    except MemoryError as error:
        raise ConfigError(f"{when}{out_of_memory(error)}") from error
