"""Estimates when an acquisition sampled within the control ticks, from the response itself.

What a logger shows of the ticks leaves some part of its sampling interval open, and a fast spool
moves far in that. The model is held against each sample at its own instant within the tick: clock
and drift are estimated together with the severities, by Gauss-Newton steps from those of the
search; what they leave unsure is in the intervals. The samples then go to one instant of the tick
by what the model moves from the one to the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.criteria import ESTIMATION, FIT_ITERATIONS, LOSSES, STD_OF_MEDIAN_SIZE
from ehadiag.identify.estimates import interval95
from ehadiag.identify.experiment import Experiment, unknowns_of
from ehadiag.identify.identification_result import Identification
from ehadiag.model.registry import FAULT_NAMES, FAULTS
from ehadiag.model.residual_models import model_response
from firmware_iface.recording import SAMPLING, Acquisition, Recording, sampling_interval, values_at

SEVERITY_STEP = 5e-4
"""Difference of a severity for its derivative, 1: a few deviations of one, so that the model bends
by less than `MAX_BENT` between break-aways."""
MAX_BENT = 0.5
"""Most by which the model may leave a line within such differences, in deviations of the noise,
which then is more than that: the tick of a break-away does."""
PARTS_OF_TICK = 16
"""Parts of a tick that the model runs through one by one, 1: a cubic lies through the ends of four
of them, and behind a step of the current the flapper takes a fifth of a tick."""


class _SampledTest(msgspec.Struct, frozen=True, eq=False):
    """An experiment whose samples an acquisition took within the control ticks."""

    experiment: Experiment
    acquired: Acquisition
    left_out: Array
    """Ticks whose spool or pressure was left out for another reason than its reading, (2, n)."""
    averaged: tuple[bool, ...]
    """Whether means of the samples of spool and pressure are taken."""

    @classmethod
    def of(cls, experiment: Experiment, acquired: Acquisition) -> _SampledTest:
        tick, signals = experiment.tick, acquired.signals[:2]
        left_out = [
            np.isnan(row) & np.isfinite(values_at(recorded, experiment.sampled, tick)[0])
            for recorded, row in zip(signals, (experiment.spool, experiment.pressure), strict=True)
        ]
        averaged = (tick >= SAMPLING.averaged * sampling_interval(item) for item in signals)
        return cls(experiment, acquired, np.stack(left_out), tuple(averaged))

    @property
    def since_middle(self) -> Array:
        """Time of each tick since the middle of the test, s, shape (n,)."""
        ticks = self.experiment.ticks
        return np.asarray((np.arange(ticks) - 0.5 * ticks) * self.experiment.tick)

    def response(self, severities: Array, before: float, parts: int = 1) -> Array:
        """Spool and pressure so long before the ends of parts of ticks, in deviations of the noise.

        Shape (2, n), n: ticks times parts.
        """
        experiment = self.experiment
        constants = unknowns_of([experiment], FAULTS).constants(severities)
        part = experiment.tick / parts
        # The model has delays of up to a step of its own.
        steps = max(int(self.delay(before) // part), 0)
        constants = constants._replace(DLY=self.delay(before) - steps * part)
        model = model_response(
            constants, np.repeat(experiment.trace.current, parts), part, origin=experiment.origin
        )
        spool, pressure = experiment.noise[:2]
        found = np.stack([model.spool / spool, model.pressure / pressure])
        first = np.repeat(found[:, :1], steps, axis=1)
        return np.concatenate([first, found[:, : found.shape[1] - steps]], axis=1)

    def delay(self, before: float) -> float:
        """Delay of samples so long before the ends of the ticks, s."""
        return self.experiment.constants.DLY - self.acquired.lead + before


class _Clock(msgspec.Struct, frozen=True, eq=False):
    """Ticks on the acquisition's clock: lead (s) and drift (1) later than they were found."""

    lead: float = 0.0
    drift: float = 0.0

    def ends(self, taken: _SampledTest) -> Array:
        """Ends of the ticks, s."""
        lead = taken.acquired.lead + self.lead
        return taken.experiment.sampled + lead + self.drift * taken.since_middle

    def instant(self, taken: _SampledTest) -> float:
        """Time before the ends at which samples are wanted, s."""
        return (taken.acquired.lead + self.lead) % taken.experiment.tick


class _Samples(msgspec.Struct, frozen=True):
    """One sample of spool and pressure for each tick."""

    value: Array
    """In deviations of the noise, NaN where there is none, shape (2, n)."""
    before: Array
    """Time before the end of the tick, s, shape (2, n)."""


def _sampled(taken: _SampledTest, clock: _Clock) -> _Samples:
    """Samples nearest to the instant that is wanted, within each tick."""
    experiment = taken.experiment
    ends, wanted, tick = clock.ends(taken), clock.instant(taken), experiment.tick
    values, before = [], []
    for recorded, left_out, averaged, offset, noise in zip(
        taken.acquired.signals[:2],
        taken.left_out,
        taken.averaged,
        (experiment.spool_offset, experiment.pressure_offset),
        experiment.noise[:2],
        strict=True,
    ):
        time, value = recorded.time, recorded.value
        if averaged:
            seen, lead = values_at(recorded, ends - wanted, tick)[0], np.full(len(ends), wanted)
        else:
            after = np.clip(np.searchsorted(time, ends - wanted), 1, len(time) - 1)
            choice = np.stack([after - 1, after])
            away = ends - time[choice]
            outside = (away < 0.0) | (away >= tick)
            best = np.argmin(np.where(outside, np.inf, np.abs(away - wanted)), axis=0)
            rows = np.arange(len(ends))
            lead = np.clip(away[best, rows], 0.0, tick)
            seen = np.where(outside.all(axis=0), np.nan, value[choice[best, rows]])
        values.append(np.where(left_out, np.nan, seen - offset) / noise)
        before.append(lead)
    return _Samples(np.stack(values), np.stack(before))


class _FineResponse:
    """Response of the model within the ticks, in deviations of the noise."""

    def __init__(self, taken: _SampledTest, severities: Array) -> None:
        self._step = taken.experiment.tick / PARTS_OF_TICK
        # The ends of the parts from that of this tick back to that of the tick before.
        grid = np.moveaxis(
            taken.response(severities, 0.0, PARTS_OF_TICK).reshape(2, -1, PARTS_OF_TICK)[..., ::-1],
            2,
            0,
        )
        start = np.concatenate([grid[-1:, :, :1], grid[:1, :, :-1]], axis=2)
        self._grid = np.concatenate([grid, start])

    def at(self, before: Array) -> tuple[Array, Array]:
        """Response so long before the ends of the ticks, s, and its derivative, 1/s; (2, n)."""
        place = before / self._step
        first = np.clip(np.floor(place).astype(np.int64) - 1, 0, len(self._grid) - 4)
        part = place - first
        channel, tick = np.indices(before.shape)
        value, slope = np.zeros(before.shape), np.zeros(before.shape)
        for k in range(4):
            others = [j for j in range(4) if j != k]
            scale = math.prod(k - j for j in others)
            factors = [part - j for j in others]
            node = self._grid[first + k, channel, tick] / scale
            value += node * factors[0] * factors[1] * factors[2]
            slope += node * (
                factors[0] * factors[1] + factors[0] * factors[2] + factors[1] * factors[2]
            )
        return value, slope / self._step


class _Fit(msgspec.Struct, frozen=True, eq=False):
    """Severities and clock, and what they leave of the samples."""

    severities: Array
    clock: _Clock
    samples: _Samples
    model: Array
    """At the samples' instants, shape (2, n)."""
    slope: Array
    """Of the model with the time before the ends, 1/s, shape (2, n)."""

    @classmethod
    def of(cls, taken: _SampledTest, severities: Array, clock: _Clock) -> _Fit:
        samples = _sampled(taken, clock)
        return cls(severities, clock, samples, *_FineResponse(taken, severities).at(samples.before))

    def cost(self, lines: _Lines) -> float:
        """Mean of Cauchy's cost of the residuals, offsets and what breaks away aside, 1."""
        total = 0.0
        for away in np.where(lines.breaks, np.nan, self.samples.value - self.model):
            left = away[np.isfinite(away)]
            left = left - np.median(left) if left.size else np.full(1, np.inf)
            total += float(np.mean(np.log1p(left**2 / ESTIMATION.cauchy_scale**2)))
        return total


class _Lines(msgspec.Struct, frozen=True, eq=False):
    """The model about a fit, at the samples' instants."""

    slopes: Array
    """Derivatives by the severities, shape (k, 2, n)."""
    breaks: NDArray[np.bool_]
    """Samples next to a break-away: at their instant, or at the one where they are wanted, the
    model is no line in the severities; shape (2, n)."""

    @classmethod
    def about(cls, taken: _SampledTest, fit: _Fit) -> _Lines:
        wanted, before = fit.clock.instant(taken), fit.samples.before
        here = np.stack([fit.model, taken.response(fit.severities, wanted)])
        slopes, bent = [], np.zeros(here.shape)
        for index, value in enumerate(fit.severities.tolist()):
            step = SEVERITY_STEP
            middle = min(max(value, step), 1.0 - step)
            points = np.repeat(fit.severities[None], 3, axis=0)
            points[:, index] = middle - step, middle, middle + step
            low, between, high = (
                here
                if x[index] == value
                else np.stack([_FineResponse(taken, x).at(before)[0], taken.response(x, wanted)])
                for x in points
            )
            slopes.append((high[0] - low[0]) / (2.0 * step))
            bent = np.maximum(bent, np.abs(0.5 * (low + high) - between))
        return cls(np.stack(slopes), bent.max(axis=0) > MAX_BENT)


class _Step(msgspec.Struct, frozen=True):
    severities: Array
    """Change of the severities, shape (k,)."""
    lead: float
    """Change of the clock's lead, s."""
    drift: float
    """Change of the clock's rate, 1."""
    variance: Array
    """Of the severities, that the clock adds, shape (k,)."""


def settle_instants(
    experiments: Sequence[Experiment], severities: Mapping[str, float]
) -> tuple[list[Experiment], Array]:
    """Return the experiments with the instants that the response shows, and variances.

    The variances, shape (k,), are what the instants add to those of the severities. severities:
    from which to start.
    """
    done = [
        (item, np.zeros(len(FAULT_NAMES)))
        if item.acquired is None
        else _settled(_SampledTest.of(item, item.acquired), severities)
        for item in experiments
    ]
    return [item for item, _ in done], np.max([variance for _, variance in done], axis=0)


def _settled(taken: _SampledTest, start: Mapping[str, float]) -> tuple[Experiment, Array]:
    """One experiment at its own instants, and the variances that they add."""
    fit = _Fit.of(taken, np.array([start[name] for name in FAULT_NAMES]), _Clock())
    lines = _Lines.about(taken, fit)
    step = _step(taken, fit, lines)
    for _ in range(FIT_ITERATIONS):
        cost = fit.cost(lines)
        for share in (1.0, 0.5, 0.25, 0.125):
            other = _Fit.of(
                taken,
                np.clip(fit.severities + share * step.severities, 0.0, 1.0),
                _Clock(fit.clock.lead + share * step.lead, fit.clock.drift + share * step.drift),
            )
            left = other.cost(lines)
            if left < cost:
                break
        else:
            break
        fit, lines = other, _Lines.about(taken, other)
        step = _step(taken, fit, lines)
    return _placed(taken, fit, lines), step.variance


def _placed(taken: _SampledTest, fit: _Fit, lines: _Lines) -> Experiment:
    """Samples at one instant of the ticks, without those next to a break-away."""
    experiment, wanted = taken.experiment, fit.clock.instant(taken)
    at = fit.clock.ends(taken) - wanted
    moved = fit.samples.value - fit.model + taken.response(fit.severities, wanted)
    spool, pressure = np.where(lines.breaks, np.nan, moved)
    position = values_at(taken.acquired.signals[2], at, experiment.tick)[0]
    return replace(
        experiment,
        sampled=at,
        spool=spool * experiment.spool_noise,
        pressure=pressure * experiment.pressure_noise,
        position=position - experiment.position_offset,
        constants=experiment.constants._replace(DLY=taken.delay(wanted)),
        acquired=taken.acquired._replace(lead=wanted),
    )


def why_sampled_seldom(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Name the rate of an acquisition that is too slow for a verdict."""
    slow = [
        (item.acquired.rate, 1e9 / item.period_ns)
        for item in ((recording.as_measured or recording).samples for recording in recordings)
        if item is not None and item.acquired is not None
    ]
    for rate, ticks in slow:
        if rate < (1.0 - LOSSES.max_wrong_share) * ticks:
            return (
                f"the acquisition took {rate:.0f} samples a second, and the computer makes"
                f" {ticks:.0f} ticks: {ticks:.0f} Hz suffice",
            )
    return ()


def widen_by_instants(found: Identification, variance: Array) -> Identification:
    """Add the uncertainty of sampling instants to the severities' intervals."""
    std = [
        math.sqrt(item.std**2 + more)
        for item, more in zip(found.estimates, variance.tolist(), strict=True)
    ]
    estimates = tuple(
        replace(item, std=wide, interval95=interval95(item.value, wide))
        for item, wide in zip(found.estimates, std, strict=True)
    )
    return replace(found, estimates=estimates, covariance=found.covariance + np.diag(variance))


def _step(taken: _SampledTest, fit: _Fit, lines: _Lines) -> _Step:
    """Gauss-Newton step of severities, clock and offsets together."""
    experiment, acquired = taken.experiment, taken.acquired
    ones, none = np.ones(experiment.ticks), np.zeros(experiment.ticks)
    columns = [
        *lines.slopes,
        fit.slope,
        fit.slope * taken.since_middle,
        np.stack([ones, none]),
        np.stack([none, ones]),
    ]
    table = np.stack([column.ravel() for column in columns], axis=1)
    left = np.where(lines.breaks, np.nan, fit.samples.value - fit.model).ravel()
    prior, about = np.zeros(table.shape[1]), np.zeros(table.shape[1])
    count = len(FAULT_NAMES)
    prior[:count] = 1.0
    prior[count : count + 2] = 1.0 / acquired.lead_std**2, 1.0 / acquired.drift_std**2
    about[count : count + 2] = -fit.clock.lead, -fit.clock.drift
    used = np.isfinite(left)
    scale = 1.0
    step: Array = np.zeros(table.shape[1])
    for _ in range(FIT_ITERATIONS):
        rows = table[used]
        information = rows.T @ rows / scale**2 + np.diag(prior)
        right = rows.T @ left[used] / scale**2 + prior * about
        step = np.asarray(np.linalg.solve(information, right))
        away = np.abs(left - table @ step)
        scale = max(STD_OF_MEDIAN_SIZE * float(np.nanmedian(away)), 1.0)
        used = np.isfinite(left) & (away <= ESTIMATION.cauchy_scale * scale)
    most = 0.5 * experiment.tick  # beyond is another tick
    rest = np.delete(np.arange(table.shape[1]), [count, count + 1])
    alone = np.linalg.inv(information[np.ix_(rest, rest)])
    more = np.diag(np.linalg.inv(information))[:count] - np.diag(alone)[:count]
    return _Step(
        step[:count],
        float(np.clip(step[count], -most, most)),
        float(step[count + 1]),
        np.maximum(more, 0.0),
    )
