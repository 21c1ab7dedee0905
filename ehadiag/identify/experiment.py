"""A recorded test prepared for identification, and its time spans laid out for the kernels."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels, conversion_of
from ehadiag.core.criteria import ANCHORING, ESTIMATION, RECORDING
from ehadiag.identify.signals import (
    CurrentTrace,
    acquired_current,
    commanded_current,
    noise_of_signal,
    relative_noise,
    rounding_noise,
)
from ehadiag.model.batch import NO_ANCHOR, Anchor, Batch
from ehadiag.model.parameter import Parameter, scaled_to_channels
from ehadiag.model.plant import SLIP_TICKS, PlantConstants, relative_viscosity
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, Unknowns, unit_constants
from firmware_iface.recording import (
    CHANNELS,
    Acquisition,
    Channel,
    Channels,
    Environment,
    Samples,
)
from firmware_iface.stored_test import StoredTest, TimeWindow


class RestRules(msgspec.Struct, frozen=True):
    """Rest of an actuator before its test."""

    displaced_share: float = 0.3e6 / CHANNELS.pressure.full_scale
    """Pressure at rest from which it is no offset of the sensor, over the converter's half range,
    1: 0.3 MPa of the default range."""
    settling_lsb: float = 5.0
    """Distance of the first samples from the second half of the rest that is no rest, LSB: a null
    bias beyond the spool's friction moves it from the first tick on. Nine deviations of half a step
    of noise and rounding (`ESTIMATION.noise_lsb`)."""
    settling_noise: float = 8.0
    """The same distance, in deviations of the noise where that is more: noise alone does not make
    it."""
    unsettled_ratio: float = 1.5
    """Ticks for which the pressure of oil that has not settled is left out, over those at rest, 1:
    it fills the chambers of a jack that sticks within 50 ms of a rest of 0.2 s, and the spool
    sticks on."""
    breakaway_s: float = 0.25
    """Longest time, s, from the command's first change to the pressure's: a spool at its limit of
    friction takes 0.1 s on a ramp of the closed test."""
    creep_s: float = 0.1
    """Time after the command's first change, s, in which a spool breaks away from where the noise
    of a closed loop has left it: at its limit of friction it takes that long on a ramp. With 0,
    0.025 and 0.05 one or two of six frictions that were 6 to 31 deviations off stay so."""
    motionless_ticks: int = 10
    """Ticks in which the jack has not yet left its middle, 1: a bound of judgement."""
    slow_noise_lsb: float = 4.0
    """Range of a jack's position by the noise of half a step of the converter, LSB: four
    deviations to either side."""


REST = RestRules()


class Experiment(msgspec.Struct, frozen=True, eq=False):
    """One recorded test, ready for identification; arrays of shape (n,)."""

    test: StoredTest
    constants: PlantConstants
    """Of the unit as new, at the oil and supply of the test, with its calibrated effects."""
    tick: float
    """s."""
    trace: CurrentTrace
    spool: Array
    """Measured less its offset, m; NaN where missing or at the converter's end."""
    pressure: Array
    """Measured less its offset, Pa; NaN where missing or at the converter's end."""
    position: Array
    """Measured less its first samples, m; NaN where missing or at the converter's end."""
    spool_noise: float
    """Standard deviation, m."""
    pressure_noise: float
    """Standard deviation, Pa."""
    position_noise: float
    """Standard deviation, m."""
    spool_offset: float
    """Already taken off `spool`, m: its mean while the actuator rests before the test moves it."""
    pressure_offset: float
    """Already taken off `pressure`, Pa."""
    position_offset: float
    """Already taken off `position`, m."""
    rested: bool
    """Whether the actuator rested long enough before the test to show them."""
    origin: float
    """Spool position before the test by the pressure at rest, m."""
    channels: Channels
    """Converters that the samples went through."""
    origin_read: bool = False
    """Whether the origin was read from the spool's sensor, and has its offset."""
    viscosity_std: float = 0.0
    """Relative standard deviation of the oil's viscosity by the bus's steps of temperature."""
    supply_std: float = 0.0
    """Standard deviation of supply less return pressure by the bus's steps, Pa."""
    acquired: Acquisition | None = None
    """How the samples were measured separately; None: they are the computer's own."""
    sampled: Array = msgspec.field(default_factory=lambda: np.empty(0))
    """When the channels of `acquired` were sampled, s on its clock; empty without it."""
    creep_end: int = 0
    """Tick before which what comes after a hold (the pressure is missing until then) does not
    count."""
    followed: bool = False
    """Whether a model follows the spool's sensor until then; searches take the sensor's offset as
    added all the same, which it is not where the spool moves later than that."""

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.spool)

    @property
    def noise(self) -> tuple[float, ...]:
        """Standard deviations of spool, pressure and position (m, Pa, m), as rows of residuals."""
        return self.spool_noise, self.pressure_noise, self.position_noise

    def anchor(self, thresholds_lsb: tuple[float, float]) -> Anchor:
        """Return how a model of it is re-anchored, by the thresholds of `Anchor`, LSB."""
        small, large = (value * self.spool_noise / ESTIMATION.noise_lsb for value in thresholds_lsb)
        return Anchor(ANCHORING.gain, small, large, JACK_ANCHOR_SHARE)

    def with_exponent(self, exponent: float, bridge: float) -> Experiment:
        """Return the same unit with another exponent of clogging; bridge: `BRG` above 0."""
        bridge = bridge if exponent > 0.0 else 0.0
        return replace(self, constants=self.constants._replace(CLE=exponent, BRG=bridge))

    def sliding(self, slip_speed: float, ring_out: float = 0.0) -> Experiment:
        """Return the same without the pressure on a jack that stands or slides more slowly.

        ring_out: time for which it rings on after that, s, and is left out, too.
        """
        if slip_speed == 0.0:
            return self
        slow = slow_ticks(self.position, self.channels.position, slip_speed * self.tick)
        if ring_out > 0.0:
            # `slow_ticks` sees a motion as many ticks before it begins.
            count, ticks = SLIP_TICKS + round(ring_out / self.tick), np.arange(len(slow))
            latest = np.maximum.accumulate(np.where(slow, ticks, -count))
            slow = ticks - latest < count
        return replace(self, pressure=np.where(slow, np.nan, self.pressure))

    @property
    def creeps(self) -> bool:
        """Whether the noise of the position moves the spool before the command does."""
        return self.test.closed_loop and not self.rested and self.constants.OIL == 0.0

    def without_creep(self, *, followed: bool = False) -> Experiment:
        """Return the same, in closed loop without what comes after a hold and before the motion.

        Without a rest the control law follows the noise of the position until the command moves.
        Where the spool creeps up to its break-away by that, the tick is decided by as little as the
        model errs, which hysteresis and a friction far off would explain. With oil in the second
        stage nothing is left out: what rings on from then leads the search. followed: whether the
        model follows the spool's sensor until then: running free it may stick elsewhere.
        """
        if not self.creeps:
            return self
        end = _ticks_before_motion(self.test) + round(REST.creep_s * self.test.rate)
        return replace(self, creep_end=end, followed=followed)

    def with_origin(self, offset: float) -> Experiment:
        """Return the same with the offset of the spool's sensor taken off an origin read by it."""
        if not self.origin_read:
            return self
        return replace(self, origin=self.origin - offset, origin_read=False)

    def with_noise(self, noise: tuple[float, ...]) -> Experiment:
        """Return the same with other standard deviations, see `noise`."""
        spool, pressure, position = noise
        return replace(self, spool_noise=spool, pressure_noise=pressure, position_noise=position)


def build_experiment(
    samples: Samples, environment: Environment, test: StoredTest, actuator: Actuator
) -> Experiment:
    """Prepare a recording for identification."""
    channels, saturated = conversion_of(samples, actuator)
    samples = replace(samples, saturated=saturated)
    spool = np.where(samples.saturated[1], np.nan, samples.spool)
    pressure = np.where(samples.saturated[2], np.nan, samples.pressure)
    position = np.where(samples.saturated[3], np.nan, samples.position)
    acquired = samples.acquired
    if acquired is not None and test.closed_loop:
        trace = acquired_current(
            samples, acquired, test, actuator.controller, channels, actuator_channels(actuator)
        )
    else:
        trace = commanded_current(samples, test, actuator.controller, channels)
    rest = _ticks_at_rest(trace.current)
    unsettled = 0
    if _settles(pressure[:rest], channels.pressure):
        rest, unsettled = 0, round(REST.unsettled_ratio * rest)
    constants = unit_constants(actuator, environment)
    if acquired is not None:
        constants = constants._replace(DLY=constants.DLY + acquired.lead)
    spool_offset, pressure_offset, origin = _offsets_at_rest(
        spool, pressure, rest, constants, test, channels.pressure
    )
    displaced = origin != 0.0 and constants.OIL == 0.0
    origin_read = displaced and _slides(position[:rest], channels.position)
    if origin_read:
        # The pressure is that of the jack's friction, and nothing shows the sensors' offsets.
        origin = _mean(spool[:rest])
        spool[:rest] = pressure[:rest] = np.nan
        rest, spool_offset, pressure_offset = 0, 0.0, 0.0
    spool, pressure = spool - spool_offset, pressure - pressure_offset
    rested = rest >= ESTIMATION.min_samples
    # A motion to and fro leaves the sensor's offset.
    centred = pressure - _mean_of_motion(pressure, test)
    slips, held = (0, 0) if rested else _held_ticks(centred, test, channels.pressure)
    if held:
        # Friction keeps spool and jack where they came to rest, and the pressure with them.
        place = float(np.nanmedian(centred[slips:held]))
        origin, origin_read = place / _rise_with_spool(constants) + constants.XLD, False
        seen, far = _mean(spool[slips:held]), REST.settling_lsb * channels.spool.lsb
        slides = _slides(position[slips:held], channels.position)
        if slides and abs(seen - origin) > far:
            # A spool that still slips began a tick's way before its first sample.
            start = float(2.0 * spool[0] - spool[1])
            origin, origin_read = (start if abs(start - seen) > far else seen), True
        # 0.1 MPa are an offset of the sensor, or 0.07 µm of the spool; where the jack slides the
        # offset of the spool's sensor is in its origin: unknown until it moves.
        ticks = np.arange(len(pressure))
        pressure = np.where(ticks < held, np.nan, pressure)
        spool = np.where(ticks < (held if slides else slips), np.nan, spool)
    elif constants.OIL > 0.0 and test.closed_loop:
        unsettled = _ticks_before_motion(test)
    # The model begins at rest; oil that has begun to ring or to fill a chamber has not.
    unsettled = unsettled if constants.OIL > 0.0 else 0
    if not rested and not held:
        unsettled = max(unsettled, _ticks_under_pressure(pressure, test, channels.pressure))
    pressure = np.where(np.arange(len(pressure)) < unsettled, np.nan, pressure)
    origin = min(max(origin, -constants.XSM), constants.XSM)
    position_offset = _mean_at_start(position)
    # Before the sines only, where that suffices: the same while the test still runs.
    quiet = _ticks_before_search(test) if noise_is_judged_early(test) else len(spool)
    return Experiment(
        test=test,
        constants=constants,
        tick=samples.period_ns * 1e-9,
        trace=trace,
        spool=spool,
        pressure=pressure,
        position=position - position_offset,
        spool_noise=noise_of_signal(spool[:quiet], channels.spool),
        pressure_noise=noise_of_signal(pressure[:quiet], channels.pressure),
        position_noise=noise_of_signal(position[:quiet], channels.position),
        spool_offset=spool_offset,
        pressure_offset=pressure_offset,
        position_offset=position_offset,
        rested=rested,
        origin=origin,
        origin_read=origin_read,
        channels=channels,
        viscosity_std=_viscosity_std(environment),
        supply_std=environment.supply_std,
        acquired=acquired,
        sampled=np.empty(0) if acquired is None else _sampling_instants(samples, acquired),
    )


def slow_ticks(position: Array, channel: Channel, least: float) -> NDArray[np.bool_]:
    """Ticks, shape (n,), around which the jack moves by less than `least`, m, a tick."""
    count = SLIP_TICKS
    seen = np.isfinite(position)
    if not seen.any():
        return np.zeros(len(position), dtype=np.bool_)
    ticks = np.arange(len(position))
    whole = np.pad(np.interp(ticks, ticks[seen], position[seen]), count, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(whole, 2 * count)[: len(position)]
    step = around[:, count:].mean(axis=1) - around[:, :count].mean(axis=1)
    limit = 2.0 * count * least + REST.slow_noise_lsb * channel.lsb
    return np.asarray((np.abs(step) < count * least) & (np.ptp(around, axis=1) < limit))


def _sampling_instants(samples: Samples, acquired: Acquisition) -> Array:
    """When the channels were sampled, s on the acquisition's clock, which runs evenly."""
    ticks = np.arange(len(samples.host_ns))
    seen = samples.host_ns >= 0
    length, first = np.polyfit(ticks[seen], samples.host_ns[seen] * 1e-9, 1)
    return np.asarray(first + length * (ticks + 1.0) - acquired.lead)


def _rise_with_spool(constants: PlantConstants) -> float:
    """Pressure on a jack at rest over the opening of the lands, Pa/m (PHY-6)."""
    return constants.GP / (1.0 + constants.GP / constants.GQ * constants.CLK)


def _rest_pressure_bounds(constants: PlantConstants) -> tuple[float, float]:
    """Least and largest pressure at rest, Pa, that a spool in its middle may leave.

    That of displaced lands vanishes where the jack moves; it is bounded by
    what lands of their shape open at most.
    """
    lap = abs(constants.LAP) * constants.GP / constants.PSR
    shape = 1.0 + abs(constants.LD2) + abs(constants.LD3) + lap
    lands = -_rise_with_spool(constants) * shape * constants.XLD
    load = abs(constants.FR) / constants.AJ
    return min(lands, 0.0) - load, max(lands, 0.0) + load


def _viscosity_std(environment: Environment) -> float:
    degc, std = environment.oil_temperature, environment.temperature_std
    if degc is None or std == 0.0:
        return 0.0
    return std * abs(relative_viscosity(degc + 1.0) / relative_viscosity(degc) - 1.0)


def _ticks_before_search(test: StoredTest) -> int:
    """Ticks of a test before its genetic search's window."""
    return round(min(begin for begin, _ in test.windows.refinement) * test.rate)


def noise_is_judged_early(test: StoredTest) -> bool:
    """Whether the test's first part is long enough to judge the noise by."""
    return _ticks_before_search(test) >= ESTIMATION.min_samples * ESTIMATION.min_ticks


def _ticks_at_rest(current: Array) -> int:
    """How long the current is zero before the test moves the actuator.

    In closed loop the noise of the jack's sensor keeps the spool moving: no rest, no offset yet.
    """
    moving = np.flatnonzero(current != 0.0)
    return int(moving[0]) if moving.size else len(current)


def _ticks_before_motion(test: StoredTest) -> int:
    """Ticks of a test before its command changes."""
    command = test.command()
    moving = np.flatnonzero(command != command[0])
    return int(moving[0]) if moving.size else 0


def _held_ticks(pressure: Array, test: StoredTest, channel: Channel) -> tuple[int, int]:
    """First and last tick (one past it) of a hold off the middle, before a closed loop's motion.

    Before the first one a spool may still slip. Two zeros where there is no such hold.
    """
    if not test.closed_loop:
        return 0, 0
    quiet = _ticks_before_motion(test)
    most = REST.settling_lsb * channel.lsb
    for begin in range(0, quiet - REST.motionless_ticks, REST.motionless_ticks):
        some = pressure[begin : begin + REST.motionless_ticks]
        if not np.isfinite(some).any() or np.nanmax(some) - np.nanmin(some) > 2.0 * most:
            continue
        place = float(np.nanmedian(some))
        if begin == 0 and abs(place) <= most:
            return 0, 0  # it rests
        moved = np.flatnonzero(np.abs(pressure[begin:] - place) > most)
        end = begin + int(moved[0]) if moved.size else len(pressure)
        if end - begin < ESTIMATION.min_ticks:
            continue  # it comes by, nothing holds it
        stands = end > quiet + round(REST.breakaway_s * test.rate)  # a sensor, not an actuator
        return (0, 0) if stands else (begin, end)
    return 0, 0


def _offsets_at_rest(
    spool: Array,
    pressure: Array,
    rest: int,
    constants: PlantConstants,
    test: StoredTest,
    channel: Channel,
) -> tuple[float, float, float]:
    """Offsets of spool and pressure sensor by the ticks at rest, SI, and the spool's place, m."""
    spool_offset, rest_pressure = _mean(spool[:rest]), _mean(pressure[:rest])
    # What the jack's load or displaced lands ask for is no offset.
    least, most = _rest_pressure_bounds(constants)
    pressure_offset = rest_pressure - min(max(rest_pressure, least), most)
    if not _is_displaced(pressure_offset, pressure, test, channel):
        return spool_offset, pressure_offset, 0.0
    # So much pressure is that of a spool that friction holds off the middle.
    origin = rest_pressure / _rise_with_spool(constants) + constants.XLD
    origin = min(max(origin, -constants.XSM), constants.XSM)
    return spool_offset - origin, 0.0, origin


def _is_displaced(offset: float, pressure: Array, test: StoredTest, channel: Channel) -> bool:
    """Whether an offset of the pressure at rest is of the spool, not of the sensor: motion to and
    fro about the same pressure says that it is the sensor's."""
    most = REST.displaced_share * channel.full_scale
    same = abs(offset - _mean_of_motion(pressure, test)) < 0.5 * most
    return abs(offset) > most and not same


def _ticks_under_pressure(pressure: Array, test: StoredTest, channel: Channel) -> int:
    """Ticks before a closed loop's motion, if they begin under pressure; 0 if not.

    A jack that sticks stands under any pressure, and the noise of each tick moves the spool.
    """
    middle = _mean_of_motion(pressure, test)
    away = abs(_mean_at_start(pressure) - middle)
    displaced = test.closed_loop and middle != 0.0 and away > REST.settling_lsb * channel.lsb
    return _ticks_before_motion(test) if displaced else 0


def _mean_of_motion(pressure: Array, test: StoredTest) -> float:
    """Mean pressure over the windows of the genetic search, Pa; 0 before enough is there."""
    time = (np.arange(len(pressure)) + 1.0) / test.rate
    inside = np.zeros(len(pressure), dtype=np.bool_)
    for begin, end in test.windows.refinement:
        inside |= (begin < time) & (time <= end)
    seen = pressure[inside & np.isfinite(pressure)]
    needed = sum(end - begin for begin, end in test.windows.refinement) * test.rate
    return float(seen.mean()) if seen.size >= RECORDING.min_sample_share * needed else 0.0


def _slides(position: Array, channel: Channel) -> bool:
    """Whether the jack travels during a hold."""
    ends = position[: REST.motionless_ticks], position[-REST.motionless_ticks :]
    if not all(np.isfinite(end).any() for end in ends):
        return False
    begin, end = (float(np.nanmean(end)) for end in ends)
    return abs(end - begin) > REST.settling_lsb * channel.lsb


def _settles(values: Array, channel: Channel) -> bool:
    """Whether a signal that should rest begins elsewhere than it stays."""
    begin, end = values[:3], values[len(values) // 2 :]
    begin, end = begin[np.isfinite(begin)], end[np.isfinite(end)]
    if not begin.size or not end.size:
        return False
    place = np.median(end)
    noise = 1.4826 * np.median(np.abs(end - place))
    most = max(REST.settling_lsb * channel.lsb, REST.settling_noise * noise)
    return bool(np.median(np.abs(begin - place)) > most)


def _mean(values: Array) -> float:
    """Mean of what is there; 0 of too little."""
    seen = values[np.isfinite(values)]
    return float(seen.mean()) if seen.size >= ESTIMATION.min_samples else 0.0


def _mean_at_start(values: Array) -> float:
    """Mean of the first samples, before anything has moved."""
    seen = values[: REST.motionless_ticks][np.isfinite(values[: REST.motionless_ticks])]
    return float(seen.mean()) if seen.size else 0.0


def share_offsets(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Take the sensors' offsets, where one test of the actuator shows them at rest, off all."""
    resting = [item for item in experiments if item.rested]
    if not resting:
        return list(experiments)
    spool = float(np.mean([item.spool_offset for item in resting]))
    pressure = float(np.mean([item.pressure_offset for item in resting]))
    return [
        item
        if item.rested
        else replace(
            item,
            spool=item.spool - spool,
            pressure=item.pressure - pressure,
            spool_offset=spool,
            pressure_offset=pressure,
        ).with_origin(spool)
        for item in experiments
    ]


WindowSpans = Sequence[Sequence[TimeWindow]]
"""Of each test, s."""
ANCHOR_THRESHOLDS_LSB = (ANCHORING.small_lsb, ANCHORING.large_lsb)
EVEN_JACK_LEVEL = 2
"""Halvings of the jack's ticks in few runs, 1: to find how each is to be cut takes as long as a
generation of the genetic search (ADR 13 at 76e9001c)."""
JACK_ANCHOR_SHARE = 0.01
"""Share of the jack's innovation by which the model is moved each tick: what lasts longer than a
tenth of a second is taken away from the residual."""


def lay_out_spans(
    experiments: Sequence[Experiment],
    windows: Sequence[Sequence[TimeWindow]] | None = None,
    *,
    lead: float = 0.0,
    channels: tuple[bool, ...] = (True, True),
    anchor_lsb: tuple[float, float] | None = None,
) -> Batch:
    """Lay spans of experiments one behind the other.

    windows: spans of each experiment to explain, s; None: all of every test. lead: run-in before
    each span, s, without weight. channels: whether spool, pressure and, where it is named, position
    count. anchor_lsb: re-anchoring thresholds (small, large) in units of LSB-sized noise; None:
    free run.
    """
    parts: list[tuple[int, int, int, int]] = []
    for index, experiment in enumerate(experiments):
        spans = [(0.0, experiment.ticks * experiment.tick)] if windows is None else windows[index]
        for start, end in spans:
            a = round(start / experiment.tick)
            b = min(round(end / experiment.tick), experiment.ticks)
            first = max(0, a - round(lead / experiment.tick))
            if b - a > 1:
                parts.append((index, first, a, b))
    if not parts:
        raise ValueError("no span of any experiment is inside its recording")
    weight, anchors, origins, places = [], [], [], []
    for index, first, a, b in parts:
        experiment = experiments[index]
        signals = experiment.spool, experiment.pressure, experiment.position
        inside = np.arange(first, b) >= a
        creep = slice(0, max(experiment.creep_end - first, 0))
        inside[creep] &= np.isnan(experiment.pressure[first:b][creep])
        rows = [
            (inside & np.isfinite(values[first:b])) * (counts / noise)
            for values, noise, counts in zip(signals, experiment.noise, channels, strict=False)
        ]
        weight.append(np.array(rows))
        anchor = NO_ANCHOR
        if anchor_lsb is not None:
            anchor = experiment.anchor(anchor_lsb)
        elif experiment.followed and experiment.creep_end > first:
            follows = experiment.anchor(ANCHOR_THRESHOLDS_LSB)
            anchor = replace(follows, follow=0.0, until=experiment.creep_end - first)
        anchors.append(anchor.as_array())
        origins.append(_origin(experiment, first))
        places.append(_place(experiment, first))
    # Nothing after the spans: a stage's inputs must not change while the test goes on.
    ends = [max((b for i, _, _, b in parts if i == k), default=0) for k in range(len(experiments))]
    begins = np.cumsum([0, *ends])
    return Batch(
        test=np.array([index for index, _, _, _ in parts]),
        tick=np.array([experiments[i].tick for i, _, _, _ in parts]),
        start=np.concatenate([[0], np.cumsum([b - first for _, first, _, b in parts])]),
        origin=np.array(origins),
        place=np.array(places),
        history=np.array([first for _, first, _, _ in parts]),
        since=np.array([begins[i] + first for i, first, _, _ in parts]),
        current=np.concatenate(
            [item.trace.current[:end] for item, end in zip(experiments, ends, strict=True)]
        ),
        spool=np.concatenate([experiments[i].spool[first:b] for i, first, _, b in parts]),
        pressure=np.concatenate([experiments[i].pressure[first:b] for i, first, _, b in parts]),
        position=np.concatenate([experiments[i].position[first:b] for i, first, _, b in parts]),
        weight=np.hstack(weight),
        anchor=np.array(anchors),
    )


def even_jack_levels(batch: Batch) -> NDArray[np.int64]:
    """Halvings of the jack's ticks, the same for all, for few runs of a model, shape (N,).

    For few it takes longer to find how each tick is to be cut than to take four steps in each.
    """
    return np.full(batch.weight.shape[1], EVEN_JACK_LEVEL)


def _origin(experiment: Experiment, first: int) -> float:
    """Spool position before tick `first`, m: where it rests before the test, else measured."""
    if first == 0:
        return experiment.origin
    before = experiment.spool[max(0, first - 5) : first]
    seen = before[np.isfinite(before)]
    return float(seen[-1]) if seen.size else 0.0


def _place(experiment: Experiment, first: int) -> float:
    """Jack position before tick `first`, m: in the middle before the test, else measured."""
    if first == 0:
        return 0.0
    before = experiment.position[max(0, first - 5) : first]
    seen = before[np.isfinite(before)]
    return float(seen.mean()) if seen.size else 0.0


def residuals_by_experiment(experiments: Sequence[Experiment], residuals: Array) -> list[Array]:
    """Residuals of each of several experiments, all its ticks, shape (signals, ticks) each.

    residuals: of all, one behind the other, shape (signals, N).
    """
    return np.split(residuals, np.cumsum([item.ticks for item in experiments])[:-1], axis=1)


def with_residual_noise(experiment: Experiment, residuals: Array) -> Experiment:
    """Weight an experiment by the noise of its residuals, shape (signals, n).

    A signal without residuals keeps the noise that it has.
    """
    shown = [
        max(noise * relative_noise(row), rounding_noise(channel))
        for noise, row, channel in zip(
            experiment.noise, residuals, experiment.channels[1:], strict=False
        )
    ]
    return experiment.with_noise((*shown, *experiment.noise[len(shown) :]))


def unknowns_of(
    experiments: Sequence[Experiment], free: Sequence[Parameter] = (*FAULTS, *SENSOR_OFFSETS)
) -> Unknowns:
    """Space of the unknowns of experiments with one actuator, on the scales of its converters."""
    mine = tuple(scaled_to_channels(item, experiments[0].channels) for item in free)
    return Unknowns(mine, tuple(item.constants for item in experiments), {})
