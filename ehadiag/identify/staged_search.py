"""Global search of the severities in stages on a growing part of the test.

Most of it runs before the test ends. The first approximation is one-dimensional searches on the
windows in which each fault shows most; the genetic search follows. A result is kept by a digest
of its inputs, so the answer is that of the finished recording alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.identify.experiment import (
    ANCHOR_THRESHOLDS_LSB,
    Experiment,
    even_jack_levels,
    lay_out_spans,
    unknowns_of,
)
from ehadiag.identify.linearisation import RUN_BLOCK_SIZE
from ehadiag.identify.solvers import SEARCH_CAP, Objective, SearchResult, Solver
from ehadiag.model.batch import Batch
from ehadiag.model.registry import FAULTS, Unknowns
from ehadiag.model.residual_models import SimdModel
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.model.simd_jack import driven_jack_costs
from firmware_iface.stored_test import StoredTest, TimeWindow


class StageRules(NamedTuple):
    """Grids and stages of the global search."""

    coarse_points: int = 2 * RUN_BLOCK_SIZE
    """Points of the coarse search over 0 … 1: two blocks of runs."""
    repeated_range: float = 0.2
    """Half-width of the second search in the slewing and the creeping spool, 1: with the other
    severity wrong the first one may be as far off; a third search brought nothing (ADR 24)."""
    fine_points: int = RUN_BLOCK_SIZE
    """Points of a finer grid, 1: a block of runs."""
    finest_spacing: float = 6e-4
    """Spacing of the last grid, 1: the refinement looks 0.0004 to 0.002 to either side (ADR 11 at
    c48f0620)."""
    run_in_s: float = 0.05
    """Run-in before a window, s; with twice as long the answers were the same (ADR 24)."""
    pressure_cap: float = SEARCH_CAP
    """Largest square of a residual of the pressure, in variances, as in the genetic search."""
    spool_cap: float = 100.0
    """Largest square of a residual of the spool, in variances: a stick-slip jump at another tick
    counts no more than ten times the noise."""
    budget_share: float = 1.0 / 12.0
    """Budgets of the solver for all stages together, 1: two generations of half a block a stage
    guard against a wrong basin; accuracy does not need them (ADR 4)."""
    first_deviation: float = 0.004
    """Standard deviation of the first stage about the first approximation, severities: ten times
    what that is off by in the mean (`tools/study paper`)."""
    narrowing: float = 0.5
    """Ratio of the deviations of two stages, 1: each sees more of the test."""


SEARCH_STAGES = StageRules()


class FirstApproximation(msgspec.Struct, frozen=True):
    """Result of the one-dimensional searches."""

    values: Mapping[str, float]
    """Severities by name."""
    evaluations: int


class FirstApproximationInputs(msgspec.Struct, frozen=True, eq=False):
    """All that the one-dimensional searches look at."""

    unknowns: Unknowns
    """Of the severities."""
    creeps: tuple[_Creep, ...]
    slewing: Batch
    creeping: Batch

    def arrays(self) -> Iterator[Array | NDArray[np.int64]]:
        """Return every number in it."""
        yield np.array(self.unknowns.base)
        for creep in self.creeps:
            yield np.array([creep.test, creep.before, creep.noise])
            yield creep.nodes
            yield creep.pressure
        yield from self.slewing
        yield from self.creeping


def _faults_by(search: str) -> list[str]:
    """Names of the faults that one response shows first."""
    return [name for name, law in FAULT_LAWS.items() if law.first_search == search]


def _windows_by(search: str, test: StoredTest) -> list[TimeWindow]:
    """Windows of a test in which one response is searched, each once."""
    windows = (getattr(test.windows, FAULT_LAWS[name].windows) for name in _faults_by(search))
    return list(dict.fromkeys(span for spans in windows for span in spans))


def first_approximation_inputs(experiments: Sequence[Experiment]) -> FirstApproximationInputs:
    """Lay out the windows of the one-dimensional searches."""
    tests = [experiment.test for experiment in experiments]
    return FirstApproximationInputs(
        unknowns=unknowns_of(experiments, FAULTS),
        creeps=tuple(
            piece
            for test, experiment in enumerate(experiments)
            for piece in _creeps(experiment, test)
        ),
        slewing=lay_out_spans(
            experiments,
            [_windows_by("slew", test) for test in tests],
            lead=SEARCH_STAGES.run_in_s,
            channels=(True, False),
        ),
        creeping=lay_out_spans(
            experiments,
            [_windows_by("creep", test) for test in tests],
            lead=SEARCH_STAGES.run_in_s,
            channels=(True, False),
            anchor_lsb=ANCHOR_THRESHOLDS_LSB,
        ),
    )


def first_approximation(inputs: FirstApproximationInputs) -> FirstApproximation:
    """Search what the driven jack shows, then slewing and creeping spool, these twice."""
    counter = _Counter()
    slewing = Objective(SimdModel(inputs.slewing, inputs.unknowns), cap=np.inf)
    creeping = Objective(SimdModel(inputs.creeping, inputs.unknowns), cap=SEARCH_STAGES.spool_cap)

    def jack_cost(points: Array) -> Array:
        candidates = inputs.unknowns.candidates(points)
        costs = [
            driven_jack_costs(
                np.ascontiguousarray(candidates[:, creep.test]),
                creep.nodes,
                creep.before,
                creep.pressure,
                creep.noise,
                SEARCH_STAGES.pressure_cap,
            )
            for creep in inputs.creeps
        ]
        return np.asarray(np.sum(costs, axis=0))

    values: dict[str, float] = {}
    jack, slew, creep = map(_faults_by, ("jack", "slew", "creep"))

    def search(
        name: str,
        cost: Callable[[Array], Array],
        others: Sequence[str],
        half_width: float | None = None,
    ) -> None:
        """Search one severity with the others as found so far; None: over all its range."""
        held: dict[str, Array | float] = {other: values.get(other, 0.0) for other in others}
        middle = values.get(name, 0.0)
        values[name] = _grid_search(
            counter,
            lambda grid: cost(_points(inputs.unknowns, **{**held, name: grid})),
            0.0 if half_width is None else middle - half_width,
            1.0 if half_width is None else middle + half_width,
            SEARCH_STAGES.coarse_points if half_width is None else SEARCH_STAGES.fine_points,
        )

    for _ in jack:  # a sweep over the severities that the driven jack shows for each of them
        for name in jack:
            search(name, jack_cost, jack)
    spool = (*slew, *creep)
    for half_width in (None, SEARCH_STAGES.repeated_range):
        for name in slew:
            search(name, slewing, spool, half_width)
        for name in creep:
            search(name, creeping, spool, half_width)
    return FirstApproximation(values, counter.count)


def _points(unknowns: Unknowns, **severities: Array | float) -> Array:
    """Points in the space of the severities, those not named at 0; shape (n, k)."""
    out = np.zeros((max(map(np.size, severities.values())), len(unknowns.free)))
    for column, item in zip(out.T, unknowns.free, strict=True):
        column[:] = severities.get(item.name, 0.0)
    return out


class _Counter:
    def __init__(self) -> None:
        self.count = 0


def _grid_search(
    counter: _Counter,
    cost: Callable[[Array], Array],
    low: float,
    high: float,
    points: int,
) -> float:
    """Minimum of a scalar function on [low, high] within 0 … 1.

    Ever finer grids about the lowest point, down to the finest spacing, all points of one at
    once; at last the vertex of the parabola through the three lowest neighbours.
    """
    while True:
        grid = np.linspace(max(low, 0.0), min(high, 1.0), points)
        values = cost(grid)
        counter.count += points
        best = int(np.argmin(values))
        spacing = float(grid[1] - grid[0])
        if spacing <= SEARCH_STAGES.finest_spacing:
            return _vertex(grid, values, best)
        low, high = float(grid[best]) - spacing, float(grid[best]) + spacing
        points = SEARCH_STAGES.fine_points


def _vertex(grid: Array, values: Array, best: int) -> float:
    """Vertex of the parabola through the lowest point and its neighbours, if it has some."""
    if not 0 < best < len(grid) - 1:
        return float(grid[best])
    left, middle, right = values[best - 1 : best + 2]
    bent = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bent if bent > 0.0 else 0.0
    return float(grid[best] + shift * (grid[1] - grid[0]))


class _Creep(msgspec.Struct, frozen=True):
    """Span in which the jack creeps, driven by the spool as it was measured.

    test: which of the tests it is of.
    before: spool position before the span, m.
    nodes: the spool's path in the form that the jack's kernel takes.
    pressure: measured, Pa, shape (n,).
    noise: of the pressure, Pa.
    """

    test: int
    before: float
    nodes: Array
    pressure: Array
    noise: float


def _creeps(experiment: Experiment, test: int) -> Iterator[_Creep]:
    ticks = np.arange(experiment.ticks)
    seen = np.isfinite(experiment.spool)
    spool = np.interp(ticks, ticks[seen], experiment.spool[seen])
    for start, end in _windows_by("jack", experiment.test):
        a = round(start / experiment.tick)
        b = min(round(end / experiment.tick), experiment.ticks)
        if b - a > 1:
            before = float(spool[a - 1]) if a else 0.0
            yield _Creep(
                test,
                before,
                _straight_path(spool[a:b], before, experiment.tick),
                experiment.pressure[a:b],
                experiment.pressure_noise,
            )


def _straight_path(spool: Array, before: float, tick: float) -> Array:
    """Straight pieces from sample to sample, in the form that the jack's kernel takes."""
    rate = np.diff(spool, prepend=before) / tick
    length = np.full(len(spool), tick)
    return np.ascontiguousarray(np.column_stack([length, spool, rate, rate, 0.0 * length]))


T = TypeVar("T")
StageProgress = Callable[[str, float], None]
"""Called with the stage and its share done, 0 … 1."""

STAGES = 3
"""Stages of the genetic search, 1: with the last one a fourth of its window is left, which the test
runs through while they are worked out (ADR 5)."""
STAGE_SHARES = tuple((stage + 1) / (STAGES + 1) for stage in range(STAGES))
"""Shares of the window of the genetic search that its stages see.

What comes later is for the last rounds of the refinement, so that all else is done before the end.
"""
SEVERITY_DEVIATION_SHARES = np.array([law.precision for law in FAULT_LAWS.values()])
"""Deviations of the severities after the first approximation, in proportion to each other."""


def _no_progress(_share: float) -> None:
    """Ignore the progress."""


class StageMemory:
    """Results of stages by a digest of their inputs; a handful, a few kilobytes in all.

    Written and read by one thread at a time.
    """

    def __init__(self) -> None:
        self._results: dict[bytes, object] = {}
        self.reused = 0
        """Stages that did not have to run again."""
        self.is_fed = False
        """Whether a recording came in parts, so that stages may come again."""

    def __len__(self) -> int:
        return len(self._results)

    def recall(self, key: bytes, kind: type[T], compute: Callable[[], T]) -> T:
        """Return what was computed from the same inputs, else compute and keep it."""
        found = self._results.get(key)
        if isinstance(found, kind):
            self.reused += 1
            return found
        result = compute()
        self._results[key] = result
        return result

    def recall_stage(self, key: Callable[[], bytes], kind: type[T], compute: Callable[[], T]) -> T:
        """Return the result of a stage; of recordings that come in one piece nothing is kept."""
        return self.recall(key(), kind, compute) if self.is_fed else compute()


def first_approximation_ready_at(test: StoredTest) -> float:
    """Instant of a test from which its first approximation can run, s.

    That of its last window, and not before the genetic search's window begins: until then the
    noise is judged.
    """
    windows = test.windows
    spans = [span for law in FAULT_LAWS.values() for span in getattr(windows, law.windows)]
    begins = min(start for start, _ in windows.refinement)
    return max(begins, *(end for _, end in spans))


def stage_ready_at(test: StoredTest, stage: int) -> float:
    """Instant of a test from which a stage of the genetic search can run, s."""
    return max(end for _, end in _first_share(test.windows.refinement, STAGE_SHARES[stage]))


def recalled_first_approximation(
    experiments: Sequence[Experiment], memory: StageMemory
) -> FirstApproximation:
    """First approximation, from memory if the inputs are the same."""
    inputs = first_approximation_inputs(experiments)
    return memory.recall_stage(
        lambda: inputs_digest("first", inputs.arrays()),
        FirstApproximation,
        lambda: first_approximation(inputs),
    )


def staged_search(stages: Iterator[SearchResult], progress: StageProgress) -> SearchResult:
    """Run the stages of a search to the end, as one result."""
    progress("search", 0.0)
    results = []
    for result in stages:
        results.append(result)
        progress("search", len(results) / len(STAGE_SHARES))
    return SearchResult(
        best=results[-1].best,
        cost=results[-1].cost,
        evaluations=sum(result.evaluations for result in results),
        generations=sum(result.generations for result in results),
        history=np.concatenate([result.history for result in results]),
    )


def search_stages(
    experiments: Sequence[Experiment],
    start: Array,
    solver: Solver,
    seed: int,
    memory: StageMemory,
    progress: Callable[[float], None] = _no_progress,
) -> Iterator[SearchResult]:
    """Results of all stages, each from the best of the one before; run on demand.

    progress: called after every generation with the share of the search done; what it raises
    ends it.
    """
    best = start
    for stage in range(len(STAGE_SHARES)):
        result = _search_stage(experiments, best, solver, seed, stage, memory, progress)
        best = result.best
        yield result


def _search_stage(
    experiments: Sequence[Experiment],
    start: Array,
    solver: Solver,
    seed: int,
    stage: int,
    memory: StageMemory,
    progress: Callable[[float], None],
) -> SearchResult:
    """One stage of the genetic search, from memory if the inputs are the same."""
    windows = [
        _first_share(item.test.windows.refinement, STAGE_SHARES[stage]) for item in experiments
    ]
    batch = lay_out_spans(experiments, windows, lead=SEARCH_STAGES.run_in_s)
    unknowns = unknowns_of(experiments, FAULTS)
    spread = (
        SEARCH_STAGES.first_deviation * SEARCH_STAGES.narrowing**stage * SEVERITY_DEVIATION_SHARES
    )
    part = solver.with_budget(round(solver.budget * SEARCH_STAGES.budget_share / len(STAGE_SHARES)))
    inputs = [*batch, np.array(unknowns.base), start, spread]
    return memory.recall_stage(
        lambda: inputs_digest(f"search {seed} {part!r}", inputs),
        SearchResult,
        lambda: part.minimise(
            Objective(SimdModel(batch, unknowns, levels=even_jack_levels(batch))),
            start,
            spread,
            seed + stage,
            lambda used, budget: progress((stage + used / budget) / len(STAGE_SHARES)),
        ),
    )


def _first_share(windows: Iterable[TimeWindow], share: float) -> list[TimeWindow]:
    """First part of windows that follow each other, by their whole length."""
    ordered = sorted(windows)
    left = share * sum(end - start for start, end in ordered)
    out = []
    for start, end in ordered:
        if left > 1e-9:
            out.append((start, min(end, start + left)))
        left -= end - start
    return out


def experiment_arrays(experiment: Experiment) -> Iterable[NDArray[np.generic]]:
    """Return all numbers that an identification of a whole test works on."""
    item = experiment
    yield np.array([*item.constants, item.tick, item.origin, float(item.rested)])
    yield np.array([*item.noise, item.spool_offset, item.pressure_offset, item.position_offset])
    yield item.trace.current
    yield item.spool
    yield item.pressure
    yield item.position


def inputs_digest(label: str, arrays: Iterable[NDArray[np.generic]]) -> bytes:
    """Fingerprint of the inputs of a stage."""
    digest = hashlib.blake2b(label.encode(), digest_size=16)
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ravel(array).data)
    return digest.digest()
