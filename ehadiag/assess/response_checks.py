"""Compares the measured signals with the response of the identified actuator.

Late samples: residuals follow the modelled derivative, and their regression is the delay.
Position sensor: its travel over a short span must be that of the modelled jack, since the
severities come from spool and pressure alone and a broken position sensor would pass unseen.
Supply: a measured pressure that stops where the modelled one rises further means a supply lower
than its probe reads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.criteria import (
    ESTIMATION,
    FIT_ITERATIONS,
    LOSSES,
    NOISE_LIMIT,
    READINGS,
    RECORDING,
    RESPONSE,
    ROUNDS,
    STD_OF_MEDIAN_SIZE,
)
from ehadiag.identify.experiment import ANCHOR_THRESHOLDS_LSB, Experiment, slow_ticks
from ehadiag.identify.identification_result import Identification
from ehadiag.identify.prior import has_further_effects
from ehadiag.model.batch import NO_ANCHOR, PRESSURE_ROW
from ehadiag.model.residual_models import ModelResponse, model_response


def identified_response(experiment: Experiment, identification: Identification) -> ModelResponse:
    """Return the response of the identified actuator to the current of an experiment.

    Where a current was guessed the spool may break away another time, and the jack travels
    otherwise for the rest of a ramp: the model is re-anchored on the spool then.
    """
    offset = identification.nuisances["spool_offset"].value
    guessed = experiment.trace.guessed > 0.0
    return model_response(
        identification.constants(experiment.constants),
        experiment.trace.current,
        experiment.tick,
        origin=experiment.origin,
        measured=experiment.spool - offset,
        anchor=experiment.anchor(ANCHOR_THRESHOLDS_LSB) if guessed else NO_ANCHOR,
    )


class Delay(msgspec.Struct, frozen=True):
    """Delay of a signal's samples."""

    name: str
    """The signal."""
    value: float
    """Ticks; positive: late."""
    std: float
    """Standard deviation, ticks."""


def estimate_delays(experiment: Experiment, found: Identification) -> tuple[Delay, ...]:
    """Regress the residuals of spool, pressure and position on the modelled derivatives.

    The standard deviation of the position's delay is infinite where the jack hardly moves.
    """
    model = identified_response(experiment, found)
    return (
        _delay("spool", experiment.spool, model.spool),
        _delay("pressure", experiment.pressure, model.pressure),
        _delay(
            "position",
            _travel(experiment, experiment.position),
            _travel(experiment, model.position),
        ),
    )


def any_significant_delay(delays: Sequence[Delay]) -> bool:
    """Whether a delay is large and certain enough to be corrected."""
    return any(
        abs(item.value) > max(RESPONSE.whole_tick, NOISE_LIMIT * item.std) for item in delays
    )


def correct_delays(
    experiments: list[Experiment],
    found: Identification,
    identify: Callable[[Sequence[Experiment]], Identification],
) -> tuple[list[Experiment], Identification, tuple[str, ...]]:
    """Correct delays that the response shows, if that explains more of the recordings.

    A delay of several ticks is seen only roughly before it is corrected, so the correction is
    repeated. Returns experiments, their identification and notes; the arguments where no delay is
    certain.
    """
    first, best = experiments, found
    total = [estimate_delays(item, found) for item in experiments]
    notes: tuple[str, ...] = ()
    for _ in range(ROUNDS):
        if not any(map(any_significant_delay, total)):
            break
        moved = [shift_samples(item, own) for item, own in zip(first, total, strict=True)]
        other = identify(moved)
        if other.fit.outliers >= best.fit.outliers:
            break
        experiments, best = moved, other
        notes = tuple(delay_note(own, first[0].tick) for own in total)
        left = [estimate_delays(item, best) for item in experiments]
        if not any(map(any_significant_delay, left)):
            break
        total = [_total_delays(own, rest) for own, rest in zip(total, left, strict=True)]
    return experiments, best, notes


def _total_delays(before: Sequence[Delay], left: Sequence[Delay]) -> tuple[Delay, ...]:
    """Delays in all: those that were corrected, and those that remain."""
    return tuple(
        replace(rest, value=own.value + rest.value) for own, rest in zip(before, left, strict=True)
    )


def shift_samples(experiment: Experiment, delays: Sequence[Delay]) -> Experiment:
    """Read late samples earlier, by straight lines between two of them."""
    spool, pressure, position = (item.value for item in delays)
    return replace(
        experiment,
        spool=_advanced(experiment.spool, spool),
        pressure=_advanced(experiment.pressure, pressure),
        position=_advanced(experiment.position, position),
    )


def delay_note(delays: Sequence[Delay], tick: float) -> str:
    """Describe corrected delays in a sentence; tick: s."""
    each = ", ".join(
        f"{item.name} {1e3 * tick * item.value:+.3f} ± {1e3 * tick * item.std:.3f} ms"
        for item in delays
    )
    return f"samples later than the ticks' ends, told by the response and put back: {each}"


def _advanced(values: Array, ticks: float) -> Array:
    """Values a number of ticks later; NaN where one of two neighbours is missing."""
    near = abs(ticks - round(ticks)) < RESPONSE.whole_tick
    whole = round(ticks) if near else math.floor(ticks)
    part = 0.0 if near else ticks - whole
    moved = _moved(values, whole)
    return moved if part == 0.0 else (1.0 - part) * moved + part * _moved(values, whole + 1)


def _moved(values: Array, ticks: int) -> Array:
    out = np.full(len(values), np.nan)
    if ticks >= 0:
        out[: len(values) - ticks] = values[ticks:]
    else:
        out[-ticks:] = values[:ticks]
    return out


def _travel(experiment: Experiment, position: Array) -> Array:
    span = round(RESPONSE.travel_span_s / experiment.tick)
    return position[span:] - position[:-span]


def _delay(name: str, measured: Array, modelled: Array) -> Delay:
    slope = np.gradient(modelled)
    left = measured - modelled
    used = np.isfinite(left)
    value, std = 0.0, np.inf
    for _ in range(FIT_ITERATIONS):
        if used.sum() < RECORDING.min_samples or not np.ptp(slope[used]):
            return Delay(name, 0.0, np.inf)
        middle = slope[used].mean()
        centred = slope[used] - middle
        power = float(centred @ centred)
        value = -float(centred @ left[used]) / power
        away = left + value * slope
        away = away - np.nanmean(away[used])
        spread = STD_OF_MEDIAN_SIZE * float(np.nanmedian(np.abs(away)))
        std = spread / float(np.sqrt(power))
        used = np.isfinite(left) & (np.abs(away) <= ESTIMATION.cauchy_scale * spread)
    return Delay(name, float(value), std * float(np.sqrt(ESTIMATION.correlation_lags)))


class PositionFit(msgspec.Struct, frozen=True):
    """Measured travel of the jack against the modelled one."""

    gain: float
    """Measured over modelled travel; NaN where the jack hardly moves."""
    drift: float
    """Of measured less modelled position, m/s."""
    rms: float
    """Of the travels that are left, in units of their noise (not below that of 1 LSB); single bad
    samples do not count."""
    outliers: float
    """Share of travels that are farther off than three times the limit of `rms`."""
    most_drift: float
    """Drift of a sound sensor at most, m/s: twice that by an unseen spool offset of the range of a
    signal that stands still."""


def fit_position(
    experiment: Experiment, modelled: ModelResponse, slip_speed: float = 0.0
) -> PositionFit | None:
    """Fit the sensor's gain and drift; None where there are too few samples of the position.

    slip_speed: m/s, below which the jack slips in steps that no model foresees: travels with such a
    part are left out.
    """
    span = round(RESPONSE.travel_span_s / experiment.tick)
    measured, model = _travel(experiment, experiment.position), modelled.position
    seen = np.isfinite(measured)
    channels = experiment.channels
    if slip_speed > 0.0:
        slow = slow_ticks(model, channels.position, slip_speed * experiment.tick)
        so_far = np.concatenate([[0], np.cumsum(slow)])
        seen &= so_far[span:-1] == so_far[: -span - 1]
    if seen.sum() < RECORDING.min_samples:
        return None
    unit = np.sqrt(2.0) * max(experiment.position_noise, channels.position.lsb)
    travel = _travel(experiment, model)[seen] / unit
    moves = (
        float(np.sqrt(np.mean(travel**2))) * unit
        >= RESPONSE.max_still_lsb * channels.position.grain
    )
    columns = [travel, np.ones_like(travel)] if moves else [np.ones_like(travel)]
    values = measured[seen] / unit - (0.0 if moves else travel)
    solution, left = _robust_fit(np.column_stack(columns), values)
    smoothed = np.abs(median_of_three(left))
    far = ESTIMATION.cauchy_scale * RESPONSE.max_travel_rms
    offset = RESPONSE.max_still_lsb * channels.spool.grain
    return PositionFit(
        gain=float(solution[0]) if moves else float("nan"),
        drift=float(solution[-1]) * unit / RESPONSE.travel_span_s,
        rms=float(np.sqrt(np.mean(np.minimum(smoothed, far) ** 2))),
        outliers=float(np.mean(smoothed > far)),
        most_drift=2.0 * offset * experiment.constants.GQ / experiment.constants.AJ,
    )


def max_position_gain_error(actuator: Actuator) -> float:
    """Largest relative gain error of the sensor that errors of actuator data may explain."""
    calibration = actuator.calibration
    own_effects = calibration is not None and (
        calibration.plays > 1 or has_further_effects(calibration)
    )
    return READINGS.max_channel_ratio_error if own_effects else RESPONSE.max_position_gain_error


def objections_to_position(
    fit: PositionFit, max_gain_error: float = RESPONSE.max_position_gain_error
) -> list[str]:
    """Reasons why the position sensor is not trusted; max_gain_error: largest error of its gain."""
    if fit.gain < -RESPONSE.min_gain:
        return ["the position sensor reads with the wrong sign"]
    if fit.gain < RESPONSE.min_gain:
        return ["the position sensor does not follow the jack: dead, frozen, or another signal"]
    if fit.outliers > LOSSES.max_wrong_share or fit.rms > RESPONSE.max_travel_rms:
        return [
            "the position sensor does not follow the jack: travel over"
            f" {RESPONSE.travel_span_s:g} s is off by {fit.rms:.1f} times the noise rms (limit"
            f" {RESPONSE.max_travel_rms:g}), {fit.outliers:.1%} of it by more than"
            f" {ESTIMATION.cauchy_scale * RESPONSE.max_travel_rms:g} times (limit"
            f" {LOSSES.max_wrong_share:.1%})"
        ]
    off = abs(fit.gain - 1.0)
    if off > max_gain_error:
        side = "high" if fit.gain > 1.0 else "low"
        return [
            f"the position sensor reads {off:.0%} too {side} (limit {max_gain_error:.0%}), or "
            "flow gain and jack area are not those of the actuator file"
        ]
    if abs(fit.drift) > fit.most_drift:
        return [
            f"the position sensor runs away by {fit.drift * 1e3:.2g} mm/s "
            f"(limit {fit.most_drift * 1e3:.2g})"
        ]
    return []


def _robust_fit(columns: Array, values: Array) -> tuple[Array, Array]:
    """Least squares reweighted by Cauchy's weights: solution and residuals."""
    weight = np.ones_like(values)
    for _ in range(FIT_ITERATIONS):
        weighed = columns * weight[:, None]
        solution = np.linalg.pinv(weighed.T @ columns) @ (weighed.T @ values)
        left = values - columns @ solution
        weight = 1.0 / (1.0 + (left / ESTIMATION.cauchy_scale) ** 2)
    return solution, left


def median_of_three(values: Array) -> Array:
    """Median of each value and its two neighbours, without the ends: a single bad value leaves no
    trace.
    """
    before, here, after = values[:-2], values[1:-1], values[2:]
    least, most = np.minimum(before, here), np.maximum(before, here)
    return np.asarray(np.maximum(least, np.minimum(most, after)))


def objections_to_supply(
    experiment: Experiment, modelled: ModelResponse, offset: float
) -> list[str]:
    """Reason to take the measured pressure for cut off; empty if it is not.

    Supply less return pressure bounds the differential pressure (PHY-6); a probe that reads too
    much shows only where that bound is reached, often for a few milliseconds of the test. offset:
    of the pressure sensor, beyond the one that `experiment` is free of, Pa.
    """
    measured = experiment.pressure - offset
    seen = np.isfinite(measured)
    if not seen.any():
        return []
    for side in (1.0, -1.0):
        got, expected = side * measured[seen], side * modelled.pressure[seen]
        top = float(got.max())
        margin = max(
            NOISE_LIMIT * experiment.noise[PRESSURE_ROW],
            RESPONSE.min_pressure_excess_share * abs(top),
        )
        # A peak that is only lower than the model's is none that is cut off.
        cut = (expected > top + margin) & (got > top - margin)
        if np.count_nonzero(cut) > 1:  # one tick's peak is a break-away's
            return [
                f"the pressure stops at {side * top * 1e-6:.2f} MPa where the model goes on to "
                f"{side * float(expected.max()) * 1e-6:.2f} MPa: supply lower than its probe says,"
                " or pressure sensor cut off"
            ]
    return []


TURNS = 3
"""Turns of the ramps of the stored test in open loop, 1: the spool breaks away once at each."""


def spool_steps(spool: Array, least: float) -> Array:
    """Sizes of the steps in which a spool moves, m.

    Parameters
    ----------
    spool : Array
        Position of each tick in a slow ramp, m; NaN where missing.
    least : float
        Least travel in a tick of a step, m.

    Returns
    -------
    Array
        Travel of each, of adjacent ticks together.
    """
    known = np.flatnonzero(np.isfinite(spool))
    change = np.diff(spool[known])
    fast = np.concatenate([[0], np.abs(change) > least * np.diff(known), [0]]).astype(int)
    edges = np.flatnonzero(np.diff(fast))
    sizes = [abs(change[a:b].sum()) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return np.array(sizes)


def creep_note(experiments: Sequence[Experiment], modelled: Sequence[Array]) -> str:
    """Say that the spool creeps in steps where the model jumps once; empty where it does not.

    Where the oil at the spool's ends yields the pressure falls as soon as the spool moves: it stops
    after a micrometre, and friction passes for hysteresis. In closed loop the sensor's noise breaks
    the spool away, so only open loop is looked at.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        What was identified from.
    modelled : Sequence[Array]
        Spool of each as the model has it, m.

    Returns
    -------
    str
        A note with number and size of the steps.
    """
    steps, jumps = np.zeros(0), np.zeros(0)
    for item, model in zip(experiments, modelled, strict=True):
        for begin, end in () if item.test.closed_loop else item.test.windows.FSS:
            ticks = slice(round(begin / item.tick), round(end / item.tick))
            least = NOISE_LIMIT * math.sqrt(2.0) * item.spool_noise
            steps = np.concatenate([steps, spool_steps(item.spool[ticks], least)])
            # The model has no noise.
            jumps = np.concatenate([jumps, spool_steps(model[ticks], 0.5 * least)])
    if len(steps) < 2.0 * max(len(jumps), TURNS):
        return ""
    if len(jumps) and (steps > 0.5 * np.median(jumps)).sum() >= len(jumps):
        return ""  # it breaks away as the model does
    expected = f"{len(jumps)} break-aways"
    if len(jumps):
        expected += f" of {np.median(jumps) * 1e6:.1f} µm"
    return (
        f"the spool creeps in {len(steps)} steps of {np.median(steps) * 1e6:.1f} µm, the model has"
        f" {expected}: the oil at the spool's ends yields, and friction looks like hysteresis"
    )
