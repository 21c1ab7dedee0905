"""Scores a stored test by the Cramér-Rao bounds of the severities, and searches better variants.

The monitoring model runs the test, with the position fed back where the test is in closed loop.
The score is how well each severity can be estimated while everything else about the unit is
unknown. A variant has segments that are longer or shorter, larger or smaller, faster or slower, and
keeps the limits of motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FRICTION_NAME
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.criteria import ESTIMATION
from ehadiag.identify.estimates import FIRST_STAGE_STD, friction_range
from ehadiag.identify.experiment import Experiment, build_experiment, lay_out_spans, unknowns_of
from ehadiag.identify.linearisation import Derivatives
from ehadiag.identify.prior import (
    UnitPrior,
    basic_nuisances_of,
    prior_information,
    unit_prior,
    usual_prior,
)
from ehadiag.model.laws import ControlState, control_current, control_law
from ehadiag.model.plant import PlantConstants
from ehadiag.model.registry import FAULT_NAMES, FAULTS, REGISTRY, SENSOR_OFFSETS
from ehadiag.model.residual_models import SimdModel
from ehadiag.monitor.streaming import Monitor, Tick
from firmware_iface.recording import CHANNELS, CommandMode, Environment, Samples
from firmware_iface.stored_test import (
    COMMAND_UNITS,
    Line,
    SearchWindows,
    Sine,
    StoredTest,
    TimeWindow,
)


class PlayedTest(msgspec.Struct, frozen=True, eq=False):
    """A test as an actuator would answer it."""

    experiment: Experiment
    """Ready for identification, its noise that of PHY-22."""
    travel: float
    """Largest distance of the jack from its middle, m."""
    rate: float
    """Largest speed of the jack, m/s."""
    pressure: float
    """Largest differential pressure, Pa."""


def play_stored_test(
    test: StoredTest,
    actuator: Actuator,
    severities: tuple[float, ...],
    effects: Mapping[str, float],
) -> PlayedTest:
    """Run a test from rest.

    severities: in the order of the registry, each 0 … 1; effects: nuisances and errors of data by
    the registry's names, SI. Returns the answer, without noise but for the fed-back position.
    ConfigurationError: a severity or an effect out of its range.
    """
    # The control law runs here, so the monitor gets currents.
    monitor = Monitor(actuator, severities, mode=CommandMode.CURRENT, effects=effects)
    channels = actuator_channels(actuator)
    lsb = channels.position.lsb
    law = control_law(actuator.controller, 1.0 / test.rate)
    commands = test.command()
    # Noise of the fed-back position (PHY-22), the same for all tests that are compared.
    noise = np.random.default_rng(0).normal(0.0, 0.5, len(commands))
    answers, seen = np.empty((len(commands), 3)), np.empty(len(commands))
    state, place = ControlState(0.0, 0.0, 0.0), 0.0
    for k, command in enumerate(commands.tolist()):
        current = command
        if test.closed_loop:
            current, state = control_current(law, state, command - place)
        answers[k] = monitor.push(Tick(current, *[float("nan")] * 4)).predicted
        # The next tick's control law works on the digitised position (BUS-7).
        place = lsb * round(float(answers[k, 2]) / lsb + float(noise[k]))
        seen[k] = place
    experiment = build_experiment(
        _samples(test, commands, answers, seen), Environment(), test, actuator
    )
    noise_of = tuple(ESTIMATION.noise_lsb * channel.grain for channel in channels[1:])
    _, pressure, travel = np.abs(answers).max(axis=0)
    rate = float(np.abs(np.diff(answers[:, 2])).max()) * test.rate
    return PlayedTest(experiment.with_noise(noise_of), float(travel), rate, float(pressure))


def _samples(
    test: StoredTest,
    commands: NDArray[np.float64],
    answers: NDArray[np.float64],
    seen: NDArray[np.float64],
) -> Samples:
    """Samples without noise, but for the position that the control law saw."""
    ticks = len(commands)
    return Samples(
        period_ns=round(1e9 / test.rate),
        mode=test.command_mode,
        current=np.full(ticks, np.nan),
        spool=answers[:, 0],
        pressure=answers[:, 1],
        position=seen,
        command=commands,
        saturated=np.zeros((len(CHANNELS), ticks), dtype=np.bool_),
        host_ns=np.full(ticks, -1, dtype=np.int64),
    )


SCORED_SEVERITIES = ((0.05, 0.05, 0.05), (0.3, 0.3, 0.3), (0.6, 0.6, 0.6))
"""Severities at which a test is scored: nearly as new, degraded, worn."""


class Bound(msgspec.Struct, frozen=True, eq=False):
    """The Cramér-Rao bound at one point, all other unknowns free."""

    severities: tuple[float, ...]
    std: NDArray[np.float64]
    """Smallest deviation of an unbiased estimate of each severity, shape (k,)."""
    laws: NDArray[np.float64]
    """What laws of the faults and a range of exponents of clogging add, whatever the test, shape
    (k,)."""
    alone: NDArray[np.float64]
    """As `std` if the severities and the sensors' offsets were all that is unknown, shape (k,)."""
    alike: tuple[tuple[str, str, float], ...]
    """A severity, what it is hardly told apart from, and the correlation of the two."""
    unseen: tuple[str, ...]
    """Parameters of which the test shows nothing."""

    @property
    def total(self) -> NDArray[np.float64]:
        """Deviation that a diagnosis states at best, shape (k,)."""
        return np.hypot(self.std, self.laws)


class Score(msgspec.Struct, frozen=True, eq=False):
    """What a test shows, and what it asks of the actuator."""

    bounds: tuple[Bound, ...]
    figure: float
    """Geometric mean of the bounds of all severities at all points, if the laws hold."""
    travel: float
    """Largest distance of the jack from its middle over the points, m."""
    rate: float
    """Largest speed of the jack, m/s."""
    pressure: float
    """Largest differential pressure, Pa."""


def score(
    test: StoredTest,
    actuator: Actuator,
    points: Sequence[tuple[float, ...]] = SCORED_SEVERITIES,
) -> Score:
    """Score a test of an actuator.

    Unknown are the severities, the sensors' offsets, the nuisances, and the data that have a
    tolerance in the actuator file. The unit has usual nuisances: what hysteresis hides is not
    there to be seen on one without any.

    actuator: data of the actuator, with their tolerances; points: severities in the order of the
    registry. ConfigurationError: a severity out of its range.
    """
    played = [play_stored_test(test, actuator, point, typical_effects()) for point in points]
    bounds = tuple(
        bound_of(item, actuator, point) for item, point in zip(played, points, strict=True)
    )
    logs = np.log([bound.std for bound in bounds])
    return Score(
        bounds,
        float(np.exp(logs.mean())),
        max(item.travel for item in played),
        max(item.rate for item in played),
        max(item.pressure for item in played),
    )


def typical_effects() -> dict[str, float]:
    """Nuisances of a usual unit, by name: the middle of what is known of any unit."""
    return {item.name: usual_prior(item).mean for item in REGISTRY if item.basic}


def bound_of(played: PlayedTest, actuator: Actuator, point: tuple[float, ...]) -> Bound:
    """Cramér-Rao bound of a test that was played at a point.

    The Fisher information is that of Gaussian noise. Ticks at which a break-away tips between both
    sides of a difference are left out: there the response has no derivative.
    """
    knowledge = unit_prior(actuator)
    basic = basic_nuisances_of(played.experiment.constants.OIL)
    free = (*FAULTS, *SENSOR_OFFSETS, *knowledge.with_free(basic))
    experiments = [played.experiment]
    model = Derivatives(
        SimdModel(lay_out_spans(experiments), unknowns_of(experiments, free)),
        played.experiment.noise,
    )
    severities = {item.name: value for item, value in zip(FAULTS, point, strict=True)}
    values = {**typical_effects(), **severities}
    x = np.array([values.get(item.name, 0.0) for item in free]) / model.scale
    slope = model.trusted_slope(x)
    rows = slope.jacobian[:, slope.smooth]
    prior = prior_information(model, knowledge.priors, knowledge.joint)
    count = len(FAULTS)
    prior[:count, :] = prior[:, :count] = 0.0
    shown = rows @ rows.T
    covariance = np.linalg.pinv(shown + prior, hermitian=True)
    known = count + len(SENSOR_OFFSETS)
    alone = np.linalg.pinv(shown[:known, :known], hermitian=True)
    spread = np.sqrt(np.diag(covariance))
    names = [item.name for item in model.estimated]
    before = np.sqrt(1.0 / np.maximum(np.diag(prior), np.finfo(float).tiny))
    std = (spread * model.scale)[:count]
    return Bound(
        severities=point,
        std=std,
        laws=_doubt_about_laws(severities, std, knowledge, played.experiment.constants),
        alone=(np.sqrt(np.diag(alone)) * model.scale[:known])[:count],
        alike=_confusable_pairs(names, covariance / np.outer(spread, spread)),
        unseen=tuple(
            name
            for k, name in enumerate(names[known:], start=known)
            # Of what was known beforehand: above it the test does not show a parameter.
            if spread[k] > 0.7 * before[k]
        ),
    )


def _doubt_about_laws(
    severities: Mapping[str, float],
    std: NDArray[np.float64],
    knowledge: UnitPrior,
    constants: PlantConstants,
) -> NDArray[np.float64]:
    """Deviation that a diagnosis adds to that of the severities, shape (k,)."""
    doubt = knowledge.discrepancy_covariance(FAULTS, severities, 1.0)
    total = np.sqrt(std**2 + np.diag(doubt))
    low, high = knowledge.exponents
    if low < high:
        clogging, friction = (FAULT_NAMES.index(name) for name in ("Kintas", FRICTION_NAME))
        found = friction_range(
            severities, total[friction], constants, (low, high), with_exponent=constants.CLE
        )
        total[friction] = found.std
        total[clogging] = np.hypot(total[clogging], FIRST_STAGE_STD * found.frictions[-1])
    return np.sqrt(np.maximum(total**2 - std**2, 0.0))


def _confusable_pairs(
    names: Sequence[str], correlation: NDArray[np.float64]
) -> tuple[tuple[str, str, float], ...]:
    """Pairs of a severity and something else that go together, the closest first."""
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(FAULTS))
        for j in range(i + 1, len(names))
        # From there on the test hardly separates them.
        if abs(correlation[i, j]) >= 0.9
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))


class VariantRules(msgspec.Struct, frozen=True):
    """Bounds of the variants of a test, and the search among them."""

    length_factors: tuple[float, float] = (0.5, 2.0)
    """Least and largest factor of a segment's length, 1."""
    amplitude_factors: tuple[float, float] = (0.25, 4.0)
    """Least and largest factor of a segment's amplitude, 1."""
    frequency_factors: tuple[float, float] = (0.25, 4.0)
    """Least and largest factor of a sine's frequency, 1."""
    max_frequency: float = 0.25
    """Frequency of the fastest sine over the control rate, 1: a period has at least four ticks."""
    generation: int = 12
    """Number of variants in a generation of the search."""
    initial_std: float = 0.3
    """Deviation of the logarithms of the factors at the beginning, 1."""


VARIANTS = VariantRules()
PENALTY_BEYOND_LIMITS = 1e3
"""Figure, 1, of a test beyond its limits, plus the excess, which leads the search back."""


class VariantSpace(msgspec.Struct, frozen=True, eq=False):
    """Variants of a test as points: logarithms of factors, 0 for the test itself."""

    test: StoredTest
    lower: NDArray[np.float64]
    """Bounds of the points, shape (k,)."""
    upper: NDArray[np.float64]
    """The same, shape (k,)."""
    largest: float
    """Largest command, in the test's unit."""

    def variant(self, point: Sequence[float] | NDArray[np.float64]) -> StoredTest:
        """Return the test at a point; its windows move with the segments that they lie in.

        point: shape (k,). Returns a valid test.
        """
        factors = iter(np.exp(np.asarray(point, dtype=np.float64)).tolist())
        tick = 1.0 / self.test.rate
        old, new = [0.0], [0.0]
        segments: list[Line | Sine] = []
        for part in self.test.segment:
            begin, length = new[-1], (part.end - part.start) * next(factors)
            end = round(begin + max(round(length / tick), 1) * tick, 9)
            larger = next(factors)
            if isinstance(part, Line):
                times = np.array([time for time, _ in part.points])
                moved = begin + (times - part.start) * (end - begin) / (part.end - part.start)
                on_ticks = np.round(np.round(moved / tick) * tick, 9)
                values = [self._held(value * larger) for _, value in part.points]
                segments.append(Line(tuple(zip(on_ticks.tolist(), values, strict=True))))
            else:
                frequency = min(
                    part.frequency * next(factors), VARIANTS.max_frequency * self.test.rate
                )
                segments.append(
                    Sine(
                        begin, end, self._held(part.amplitude * larger), _rounded_number(frequency)
                    )
                )
            old.append(part.end)
            new.append(end)
        return msgspec.structs.replace(
            self.test,
            segment=tuple(segments),
            windows=_moved_windows(self.test.windows, old, new),
        )

    def _held(self, value: float) -> float:
        return _rounded_number(min(max(value, -self.largest), self.largest))


def variant_space(test: StoredTest, rated_current: float) -> VariantSpace:
    """Return the variants of a test, within the factors of `VARIANTS`.

    A current command does not go beyond the rated current (A).
    """
    bounds = []
    for part in test.segment:
        bounds += [VARIANTS.length_factors, VARIANTS.amplitude_factors]
        if isinstance(part, Sine):
            bounds.append(VARIANTS.frequency_factors)
    lower, upper = np.log(np.array(bounds)).T
    unit = COMMAND_UNITS[test.mode][test.unit]
    largest = float("inf") if test.closed_loop else rated_current / unit
    return VariantSpace(test, lower, upper, largest)


def _moved_windows(windows: SearchWindows, old: list[float], new: list[float]) -> SearchWindows:
    """Windows whose ends go where the segments' ends went, in proportion between."""

    def there(spans: Sequence[TimeWindow]) -> tuple[TimeWindow, ...]:
        ends = np.round(np.interp(np.array(spans), old, new), 4)
        return tuple((begin, min(end, new[-1])) for begin, end in ends.tolist())

    return SearchWindows(
        **{name: there(getattr(windows, name)) for name in windows.__struct_fields__}
    )


def _rounded_number(value: float) -> float:
    """A number of four significant digits, as in a test file."""
    return float(f"{value:.4g}")


class MotionLimits(msgspec.Struct, frozen=True):
    """Largest motion, pressure and duration of a test."""

    travel: float
    """Of the jack from its middle, m."""
    rate: float
    """Of the jack, m/s."""
    pressure: float
    """Differential, Pa."""
    duration: float
    """s."""

    def excess(self, travel: float, rate: float, pressure: float, duration: float) -> float:
        """By how much the worst is exceeded, as a share; 0 where nothing is."""
        shares = (
            travel / self.travel,
            rate / self.rate,
            pressure / self.pressure,
            duration / self.duration,
        )
        return max(max(shares) - 1.0, 0.0)


class Proposal(msgspec.Struct, frozen=True, eq=False):
    """A test that was found."""

    test: StoredTest
    score: Score
    scored: int
    """Tests that were looked at."""
    better: bool
    """Whether it is better than the test that the search began with, or that one exceeded limits.
    """


def propose(
    test: StoredTest,
    actuator: Actuator,
    limits: MotionLimits,
    *,
    budget: int = 200,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Proposal | None:
    """Search the variants of a test for the lowest figure; None where all exceed the limits.

    An evolution strategy with diagonal adaptation from the best quarter of each generation
    (cross-entropy method, R. Rubinstein, Methodology and Computing in Applied Probability 1, 1999).

    test: where the search begins; budget: tests to look at; seed: the same seed gives the same
    test; progress: called after each test with the share of the budget that is spent.
    """
    space = variant_space(test, actuator.controller.IM)
    rng = np.random.default_rng(seed)
    mean, spread = np.zeros(len(space.lower)), np.full(len(space.lower), VARIANTS.initial_std)
    first = _figure(space, mean, actuator, limits)
    best, lowest, scored = mean, first, 1
    while scored + VARIANTS.generation <= budget:
        points = np.clip(
            mean + spread * rng.standard_normal((VARIANTS.generation, len(mean))),
            space.lower,
            space.upper,
        )
        points[0] = best
        figures = [lowest]
        for point in points[1:]:
            figures.append(_figure(space, point, actuator, limits))
            scored += 1
            if progress is not None:
                progress(scored / budget)
        order = np.argsort(figures)
        if figures[order[0]] < lowest:
            best, lowest = points[order[0]], figures[order[0]]
        chosen = points[order[: VARIANTS.generation // 4]]
        mean = 0.5 * (mean + chosen.mean(axis=0))
        spread = 0.7 * spread + 0.3 * chosen.std(axis=0)
    if lowest >= PENALTY_BEYOND_LIMITS:
        return None
    found = space.variant(best)
    return Proposal(found, score(found, actuator), scored, lowest < first)


def _figure(
    space: VariantSpace, point: NDArray[np.float64], actuator: Actuator, limits: MotionLimits
) -> float:
    """Figure of a variant; of one beyond its limits one larger than any."""
    test = space.variant(point)
    # As new the jack goes farthest and fastest: what is too much there is not scored.
    new = play_stored_test(test, actuator, (0.0,) * len(SCORED_SEVERITIES[0]), typical_effects())
    excess = limits.excess(new.travel, new.rate, new.pressure, test.duration)
    if excess > 0.0:
        return PENALTY_BEYOND_LIMITS * (1.0 + excess)
    found = score(test, actuator)
    excess = limits.excess(found.travel, found.rate, found.pressure, test.duration)
    return PENALTY_BEYOND_LIMITS * (1.0 + excess) if excess > 0.0 else found.figure
