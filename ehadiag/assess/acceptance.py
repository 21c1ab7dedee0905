"""Whether a recording, and the actuator file that it is judged by, can carry a verdict at all.

Relations between channels hold on any motion, whatever the faults: a wrong unit or sign shows,
and so does a jack that does not travel as the spool's flow makes it, or a sensor that reads many
times what the actuator can do. An actuator file whose ratios are far from those of any built
actuator is refused too: a search would take minutes and explain the recording by no severities.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import msgspec
import numpy as np

from ehadiag.assess.response_checks import median_of_three
from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.conversion import actuator_channels, conversion_of, largest_value
from ehadiag.core.criteria import ESTIMATION, LOSSES, READINGS, RECORDING, RESPONSE
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.signals import COMMAND_FRAME_TOLERANCE
from ehadiag.model.plant import REFERENCE_TEMPERATURE
from firmware_iface.recording import (
    CHANNELS,
    BitState,
    CommandMode,
    Environment,
    Recording,
    Samples,
)
from firmware_iface.stored_test import RATE_TOLERANCE, StoredTest


def is_complete_recording(recording: Recording, test: StoredTest) -> bool:
    """Whether a recording has the end of a test, and no frame of it may still come.

    What is missing longer than `RECORDING.max_frame_delay_s` before the end is lost; a channel of
    which there is nothing at all is not on this bus.
    """
    samples = recording.samples
    if samples is None or samples.ticks != test.ticks:
        return False
    if recording.test_id not in (None, test.id):
        return False
    if recording.outcome.state is not BitState.COMPLETE:
        return False
    end = slice(-round(RECORDING.max_frame_delay_s * test.rate) or None, None)
    measured = samples.current, samples.spool, samples.pressure, samples.position
    for values in (*measured, samples.command):
        seen = np.isfinite(values)
        if seen.any() and not seen[end].all():
            return False
    return True


def objections_to_recording(
    recording: Recording, test: StoredTest | None, actuator: Actuator
) -> list[str]:
    """Why a recording cannot be diagnosed; empty if it can."""
    if recording.outcome.state is BitState.REFUSED:
        return [
            f"refused by the flight-control computer: {_plain_words(recording.outcome.reason.name)}"
        ]
    if recording.outcome.state is BitState.ABORTED:
        return ["the test was aborted"]
    samples = recording.samples
    if samples is None:
        return [*recording.quality.refused, "no telemetry of a test in the recording"]
    beyond = objections_to_readings(samples, actuator)
    if test is None and recording.test_id is None:
        return beyond or [
            "the recording does not say which test it is of: name the test by --test; of a test in"
            " several files join these by --merge"
        ]
    if test is None:
        return [f"test {recording.test_id} is none of the stored tests: name its file by --test"]
    return [
        *recording.quality.refused,
        *beyond,
        *_test_mismatches(samples, test, actuator),
        *_gaps(samples, test),
        *objections_to_conditions(recording.environment, samples, actuator),
    ]


def objections_to_unit(recordings: Sequence[Recording], actuator: Actuator) -> list[str]:
    """Why recordings are not of the unit that an actuator file was calibrated for; else empty."""
    own = actuator.calibration.serial if actuator.calibration else None
    others = {item.serial for item in recordings} - {None, own}
    if own is None or not others:
        return []
    return [
        f"the actuator file is calibrated for serial {own}, the recording is of serial "
        f"{', '.join(str(serial) for serial in sorted(others, key=str))}"
    ]


def objections_to_duplicates(recordings: Sequence[Recording]) -> list[str]:
    """Say which recordings are others once more: what they show would count twice."""
    seen: dict[bytes, str] = {}
    out = []
    for recording in recordings:
        if recording.samples is None:
            continue
        samples = recording.samples
        key = b"".join(
            part.tobytes()
            for part in (samples.current, samples.spool, samples.pressure, samples.position)
        )
        if key in seen:
            out.append(f"{recording.source} has the samples of {seen[key]}: name each test once")
        seen.setdefault(key, recording.source)
    return out


def _test_mismatches(samples: Samples, test: StoredTest, actuator: Actuator) -> list[str]:
    out = []
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    commands = int(np.isfinite(samples.command).sum())
    if test.closed_loop and commands < RECORDING.min_samples:
        if np.isfinite(samples.current[: test.ticks]).mean() < RECORDING.min_sample_share:
            out.append(
                f"{commands or 'no'} command frames in the recording, nor the servovalve current:"
                " closed loop cannot be judged without: record the message with the command too,"
                " and name it in the mapping"
            )
    elif commands and samples.mode is not mode:
        out.append(
            f"the command is a {samples.mode.name.lower()}, test {test.name!r} needs another"
        )
    if abs(samples.period_ns * 1e-9 * test.rate - 1.0) > RATE_TOLERANCE:
        out.append(f"telemetry every {samples.period_ns / 1e6:g} ms, test at {test.rate:g} Hz")
    elif abs(actuator.controller.rate / test.rate - 1.0) > RATE_TOLERANCE:
        out.append(f"controller at {actuator.controller.rate:g} Hz, test at {test.rate:g} Hz")
    return out


def _gaps(samples: Samples, test: StoredTest) -> list[str]:
    out, least = [], RECORDING.min_sample_share
    for name, values in (("spool", samples.spool), ("pressure", samples.pressure)):
        present = np.flatnonzero(np.isfinite(values[: test.ticks]))
        share = 1.0 - len(present) / test.ticks
        edges = np.concatenate([[-1], present, [test.ticks]])
        longest = float(np.diff(edges).max() - 1) / test.rate
        if share > 1.0 - least:
            out.append(f"{share:.0%} of the {name} samples are missing (limit {1.0 - least:.0%})")
        elif longest > RECORDING.max_sample_gap_s:
            out.append(
                f"no {name} sample for {longest:.2f} s (limit {RECORDING.max_sample_gap_s:g} s)"
            )
    both = np.isfinite(samples.spool[: test.ticks]) & np.isfinite(samples.pressure[: test.ticks])
    for search in test.windows.__struct_fields__:
        for start, end in getattr(test.windows, search):
            inside = both[round(start * test.rate) : round(end * test.rate)]
            if inside.sum() < least * (end - start) * test.rate:
                out.append(f"samples are missing in {start:g} … {end:g} s, which {search} needs")
    return out


def objections_to_conditions(
    environment: Environment, samples: Samples, actuator: Actuator
) -> list[str]:
    """What the model must not be run with; holds for a running test too."""
    out = []
    saturated = conversion_of(samples, actuator).saturated
    for index, name in ((1, "spool"), (2, "pressure"), (3, "position")):
        share = float(np.mean(saturated[index]))
        if share > LOSSES.max_wrong_share:
            out.append(f"{share:.0%} of the {name} samples stand at the converter's end")
    return out + objections_to_environment(environment, actuator)


def objections_to_environment(environment: Environment, actuator: Actuator) -> list[str]:
    """Why the model must not be run with this oil and supply; empty if it may."""
    out = []
    temperature = environment.oil_temperature
    if (
        temperature is not None
        and not RECORDING.oil_temperature_range_degc[0]
        <= temperature
        <= RECORDING.oil_temperature_range_degc[1]
    ):
        out.append(
            f"oil at {temperature:g} degC, outside {RECORDING.oil_temperature_range_degc[0]:g} … "
            f"{RECORDING.oil_temperature_range_degc[1]:g}"
        )
    if environment.supply_pressure is not None and environment.return_pressure is not None:
        supply = environment.supply_pressure - environment.return_pressure
        usual = actuator.servovalve.PSR
        least = READINGS.min_supply_pressure_share
        if not least * usual <= supply <= READINGS.max_reading_factor * usual:
            out.append(
                f"supply {supply / 1e6:.1f} MPa above return, "
                f"the actuator's data say {usual / 1e6:.1f} MPa"
            )
    return out


def objections_to_experiment(experiment: Experiment) -> list[str]:
    """Why the inputs of a test are not what they should be; empty if they are."""
    out = []
    trace, test = experiment.trace, experiment.test
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    channels = experiment.channels
    full_scale = (channels.position if test.closed_loop else channels.current).full_scale
    if trace.command_deviation > max(
        COMMAND_FRAME_TOLERANCE[mode] * full_scale, trace.command_step
    ):
        unit = "mm" if test.closed_loop else "mA"
        out.append(
            f"the command differs from test {test.name!r} by up to "
            f"{trace.command_deviation * 1e3:.3g} {unit}: another test was played"
        )
    if current := objection_to_current(experiment):
        out.append(current)
    if lost := objection_to_lost_positions(experiment):
        out.append(lost)
    for name, values in (("spool", experiment.spool), ("pressure", experiment.pressure)):
        seen = values[np.isfinite(values)]
        if seen.size and float(np.ptp(seen)) == 0.0:
            out.append(f"the {name} signal is frozen")
    return out


def objection_to_current(experiment: Experiment) -> str:
    """Why the measured current is none that the test asks for; empty if it is."""
    trace, channels = experiment.trace, experiment.channels
    # The current's own noise is not to be had in closed loop; the other converters' stands for it.
    noise_lsb = min(
        experiment.spool_noise / channels.spool.grain,
        experiment.pressure_noise / channels.pressure.grain,
    )
    limit_lsb = RECORDING.max_control_residual_lsb * max(1.0, noise_lsb / ESTIMATION.noise_lsb)
    if not trace.residual_lsb > limit_lsb:
        return ""
    return (
        f"servovalve current {trace.residual_lsb:.1f} LSB rms from what the "
        f"{'control law' if experiment.test.closed_loop else 'command'} gives (limit "
        f"{limit_lsb:.2g}): controller data wrong, or the current driver failed"
    )


def notes_on_recording(
    recording: Recording, test: StoredTest | None, actuator: Actuator
) -> tuple[str, ...]:
    """What was assumed and what is missing, where a verdict can be given all the same."""
    samples = recording.samples
    if samples is None:
        return ()
    out = []
    environment = recording.environment
    if environment.oil_temperature is None:
        out.append(f"no oil temperature on the bus: {REFERENCE_TEMPERATURE:g} degC assumed")
    if environment.supply_pressure is None or environment.return_pressure is None:
        supply = actuator.servovalve.PSR / 1e6
        out.append(f"no supply pressure on the bus: the actuator file's {supply:g} MPa assumed")
    if test is not None and test.closed_loop and not np.isfinite(samples.command).any():
        out.append(f"no command recorded: that of test {test.name!r}, which the current bears out")
    present = np.flatnonzero(np.isfinite(samples.spool))
    if test is not None and len(present):
        first = float(present[0]) / test.rate
        last = max(test.ticks - 1 - float(present[-1]), 0.0) / test.rate
        if first >= RECORDING.max_frame_delay_s:
            out.append(f"the first {first:.3f} s of the test are missing")
        if last >= RECORDING.max_frame_delay_s:
            out.append(f"the last {last:.3f} s of the test are missing: the recording ends early")
        elif recording.outcome.state is BitState.RUNNING:
            out.append("the recording ends before the computer's word that the test is complete")
    return tuple(out)


def _plain_words(name: str) -> str:
    return name.lower().replace("_", " ")


def objection_to_lost_positions(experiment: Experiment) -> str:
    """Reason why a test's current cannot be rebuilt; empty if it can."""
    guessed = experiment.trace.guessed
    if guessed <= LOSSES.max_wrong_share:
        return ""
    return (
        f"{guessed:.1%} of the jack positions that the control law worked on are lost "
        f"(limit {LOSSES.max_wrong_share:.1%}) and not told by the response: the servovalve "
        f"current cannot "
        "be rebuilt"
    )


def objection_to_frame_order(recording: Recording) -> str:
    """Reason why the ticks of a recording's samples are uncertain; empty if they are not."""
    share = recording.out_of_order
    if not recording.by_time or share <= LOSSES.max_wrong_share:
        return ""
    return (
        f"by their time stamps {share:.0%} of the commands are of other ticks (limit "
        f"{LOSSES.max_wrong_share:.1%}): the frames have lost their order, and no counter "
        "tells it"
    )


UNITS = (
    (1000.0, "a unit 1000 times smaller was sent", "a unit 1000 times larger was sent"),
    (10.0, "a unit ten times smaller was sent", "a unit ten times larger was sent"),
    (25.4, "millimetres were sent as inches", "inches were sent as millimetres"),
    (14.5038, "psi were sent as bar", "bar were sent as psi"),
)
"""Ratios of units that are taken for one another; what multiplies, and what divides by one."""
UNIT_ERROR_FACTORS: tuple[tuple[float, str], ...] = (
    (-1.0, "its sign is reversed"),
    *((factor, more) for factor, more, _ in UNITS),
    *((1.0 / factor, less) for factor, _, less in UNITS),
)
"""Measured over true value, and what makes that."""


class ChannelRelation(msgspec.Struct, frozen=True):
    """Slope of one channel over another, as measured, over what the actuator's data say."""

    upper: str
    """Channel whose error raises the ratio."""
    lower: str
    """Channel whose error lowers it."""
    ratio: float
    """1 where both units and signs are right."""


def channel_relations(samples: Samples, actuator: Actuator) -> tuple[ChannelRelation, ...]:
    """Compare the channels with each other, as far as the motion shows.

    Spool over current is the torque motor's gain over the feedback wire's stiffness (PHY-4);
    velocity of the jack over spool the flow gain over its area (PHY-6, PHY-7); the current that of
    its command, or of the control law (PHY-2, PHY-3).
    """
    valve, jack = actuator.servovalve, actuator.jack
    velocity, half = _velocity(samples)
    found = [
        _relation("spool", "current", samples.spool, samples.current, valve.GM / valve.KSF),
        _relation("position", "spool", velocity, _smooth(samples.spool, half), valve.GQ / jack.AJ),
    ]
    if samples.mode is CommandMode.CURRENT:
        found.append(_relation("command", "current", samples.command, samples.current, 1.0))
    elif np.isfinite(samples.command).any():
        found.append(_relation("command", "position", samples.command, samples.position, 1.0))
    return tuple(item for item in found if item is not None)


def objections_to_units(samples: Samples, actuator: Actuator) -> tuple[str, ...]:
    """Return a sentence for each channel with a wrong unit or sign; none without motion.

    Of several explanations that with the fewest channels is chosen.
    """
    found = channel_relations(samples, actuator)
    out = list(_explained(found))
    pressure = _pressure(samples, actuator, {item.lower for item in found})
    return (*out, *pressure)


def objections_to_readings(samples: Samples, actuator: Actuator) -> list[str]:
    """Return a sentence for each channel whose readings are too large for its unit or scale."""
    out = []
    for channel in CHANNELS:
        values = np.abs(np.asarray(getattr(samples, channel.name)))
        values = values[np.isfinite(values)]
        largest, unit = largest_value(actuator, channel), channel.per_unit
        top = float(np.quantile(values, 1.0 - LOSSES.max_wrong_share)) if values.size else 0.0
        if top > READINGS.max_reading_factor * largest:
            out.append(
                f"{channel.name} reads {top / unit:.3g} {channel.unit}, the actuator reaches"
                f" {largest / unit:.3g} {channel.unit}: check unit and scale of its signal"
            )
    return out


def _explained(found: tuple[ChannelRelation, ...]) -> tuple[str, ...]:
    if all(abs(item.ratio - 1.0) <= READINGS.max_channel_ratio_error for item in found):
        return ()
    names = sorted({name for item in found for name in (item.upper, item.lower)})
    for count in (1, 2):
        best: tuple[float, tuple[str, ...]] | None = None
        for wrong in itertools.combinations(names, count):
            for choice in itertools.product(UNIT_ERROR_FACTORS, repeat=count):
                factor = {name: value for name, (value, _) in zip(wrong, choice, strict=True)}
                off = max(
                    abs(item.ratio * factor.get(item.lower, 1.0) / factor.get(item.upper, 1.0) - 1)
                    for item in found
                )
                words = tuple(
                    f"{name}: {text}, or the mapping says so"
                    for name, (_, text) in zip(wrong, choice, strict=True)
                )
                if off <= READINGS.max_channel_ratio_error and (best is None or off < best[0]):
                    best = (off, words)
        if best is not None:
            return best[1]
    return tuple(
        f"{item.upper} moves {item.ratio:.3g} times as much with the {item.lower} as the actuator's"
        " data say"
        for item in found
        if abs(item.ratio - 1.0) > READINGS.max_channel_ratio_error
    )


def _pressure(samples: Samples, actuator: Actuator, moved: set[str]) -> tuple[str, ...]:
    """Hold the pressure that moves the jack against the friction that it may have."""
    jack = actuator.jack
    velocity, _ = _velocity(samples)
    present = np.isfinite(velocity) & np.isfinite(samples.pressure)
    if present.sum() < RECORDING.min_samples or "spool" not in moved:
        return ()
    present &= np.abs(velocity) > np.median(np.abs(velocity[present]))
    force = jack.AJ * samples.pressure[present] - jack.FR
    usual = float(np.median(np.abs(force)))
    # Viscous friction adds to it.
    low, high = jack.FDJ0, (1.0 + READINGS.max_channel_ratio_error) * jack.FDJ1
    ahead = float(np.mean(np.sign(force) == np.sign(velocity[present])))
    if ahead < 0.5:
        return ("pressure: its sign is reversed against the jack's motion, or the mapping says so",)
    if low <= usual <= high:
        return ()
    fits = [
        text for value, text in UNIT_ERROR_FACTORS if value > 0 and low <= usual / value <= high
    ]
    why = " or ".join(fits) if fits else "another unit was sent"
    return (
        f"pressure: {usual:.3g} N move the jack, its friction is {jack.FDJ0:g} …"
        f" {jack.FDJ1:g} N: {why}",
    )


def _relation(
    upper: str, lower: str, y: Array, x: Array, expected: float
) -> ChannelRelation | None:
    present = np.isfinite(x) & np.isfinite(y)
    if present.sum() < RECORDING.min_samples:
        return None
    x, y = x[present] - x[present].mean(), y[present] - y[present].mean()
    power, other = float(x @ x), float(y @ y)
    if (
        power == 0.0
        or other == 0.0
        or abs(float(x @ y)) < READINGS.min_correlation * np.sqrt(power * other)
    ):
        return None
    return ChannelRelation(upper, lower, float(x @ y) / power / expected)


def _velocity(samples: Samples) -> tuple[Array, int]:
    """Mean velocity of the jack about each tick, m/s, NaN near the ends; half its span, ticks."""
    position, period = samples.position, samples.period_ns * 1e-9
    half = max(round(0.5 * RESPONSE.travel_span_s / period), 1)
    out = np.full(len(position), np.nan)
    if len(position) > 2 * half:
        out[half:-half] = (position[2 * half :] - position[: -2 * half]) / (2 * half * period)
    return out, half


def _smooth(values: Array, half: int) -> Array:
    """Mean over the same ticks, of what is there."""
    present = np.isfinite(values)
    kernel = np.ones(2 * half)
    if len(values) < len(kernel):
        return values
    total = np.convolve(np.where(present, values, 0.0), kernel, "same")
    count = np.convolve(present.astype(np.float64), kernel, "same")
    return np.where(count > half, total / np.maximum(count, 1.0), np.nan)


def objections_to_travel(samples: Samples, test: StoredTest, actuator: Actuator) -> list[str]:
    """Name the sensor that shows another motion than the other channels; empty where all agree.

    Only in closed loop, where the control law works on the position: a search would take long.
    The jack's velocity is close to the spool's position times flow gain over jack area (PHY-6,
    PHY-7), so that both travels correlate. The current, which the spool follows, shows which of the
    two sensors is wrong.
    """
    travels = _travels(samples, actuator) if test.closed_loop else None
    if travels is None:
        return []
    expected, measured = travels
    least = RESPONSE.max_still_lsb * actuator_channels(actuator).position.grain
    moved = float(expected.std()), float(measured.std())
    if max(moved) < least:
        return []
    correlation = float(np.mean((expected - expected.mean()) * (measured - measured.mean())))
    correlation /= max(moved[0] * moved[1], np.finfo(np.float64).tiny)
    if correlation >= READINGS.min_correlation:
        return []
    spool_follows = any(
        item.upper == "spool" and item.lower == "current" and item.ratio > 0.0
        for item in channel_relations(samples, actuator)
    )
    sensor = "position" if spool_follows else "spool"
    if correlation < -READINGS.min_correlation:
        return [f"the {sensor} sensor reads with the wrong sign"]
    what = (
        "the position does not follow the flow that the spool lets through: jack seized or at its "
        "end, or position sensor dead, frozen, or another signal"
        if spool_follows
        else "the spool follows neither the current nor the jack's motion: spool sensor dead, "
        "frozen, or another signal, or torque motor wired the wrong way round"
    )
    return [
        f"{what} (correlation of the jack's travel with the spool's flow {correlation:.2f}, "
        f"at least {READINGS.min_correlation:.2g} needed)"
    ]


def _travels(samples: Samples, actuator: Actuator) -> tuple[Array, Array] | None:
    """Travel over the span by the spool's flow and by the position sensor, m; None: too few."""
    tick = samples.period_ns * 1e-9
    span = round(RESPONSE.travel_span_s / tick)
    seen = np.flatnonzero(np.isfinite(samples.spool))
    if len(seen) < RECORDING.min_samples or len(samples.spool) <= span + 2:
        return None
    spool = np.interp(np.arange(len(samples.spool)), seen, samples.spool[seen])
    gain = actuator.servovalve.GQ / actuator.jack.AJ
    passed = np.concatenate([[0.0], np.cumsum(spool[:-1])]) * tick * gain
    expected = passed[span:] - passed[:-span]
    position = _without_spikes(samples.position)
    measured = position[span:] - position[:-span]
    present = np.isfinite(measured)
    if present.sum() < RECORDING.min_samples:
        return None
    return expected[present], measured[present]


def _without_spikes(values: Array) -> Array:
    """Median of each known value and its known neighbours."""
    out, seen = values.copy(), np.flatnonzero(np.isfinite(values))
    present = values[seen]
    if len(seen) > 2:
        out[seen[1:-1]] = median_of_three(present)
    return out


def objections_to_actuator(actuator: Actuator) -> list[str]:
    """Why an actuator file cannot be right, with the data to look at; empty if it can."""
    most = READINGS.max_actuator_ratio_factor
    usual = _usual_ratios()
    return [
        f"actuator file: {what} is {ratio:.2g}, usual is {usual[what, data]:.2g}: check {data}"
        for (what, data), ratio in _ratios(actuator).items()
        if not 1.0 / most <= ratio / usual[what, data] <= most
    ]


@cache
def _usual_ratios() -> dict[tuple[str, str], float]:
    return _ratios(default_actuator())


def _ratios(actuator: Actuator) -> dict[tuple[str, str], float]:
    """Ratios that are alike for actuators of all sizes, by what they are and of which data."""
    controller, valve, jack = actuator.controller, actuator.servovalve, actuator.jack
    slew = valve.GQF * valve.XFM / valve.AS
    speed = valve.GQ * valve.XSM / jack.AJ
    force = valve.GPF * valve.XFM * valve.AS
    return {
        ("spool travel at rated current over spool stop", "GM, IM, KSF, XSM"):
            valve.GM * controller.IM / valve.KSF / valve.XSM,
        ("flapper travel at rated current over flapper stop", "GM, IM, KF, XFM"):
            valve.GM * controller.IM / valve.KF / valve.XFM,
        ("spool travel in 1 s over spool stop", "GQF, XFM, AS, XSM"): slew / valve.XSM,
        ("first stage's force over spool friction at the limit", "GPF, XFM, AS, FSS1"):
            force / valve.FSS1,
        ("spool acceleration by the first stage over that to its speed in 1 s",
         "GPF, XFM, AS, MS, GQF"): force / valve.MS / slew,
        ("pressure at the spool's stop over supply", "GP, XSM, PSR"):
            valve.GP * valve.XSM / valve.PSR,
        ("jack travel in 1 s over jack stop", "GQ, XSM, AJ, XJM"): speed / jack.XJM,
        ("jack force over jack friction at the limit", "PSR, AJ, FDJ1"):
            valve.PSR * jack.AJ / jack.FDJ1,
        ("jack acceleration by the supply over that to its speed in 1 s", "PSR, AJ, MJ, GQ, XSM"):
            valve.PSR * jack.AJ / jack.MJ / speed,
    }  # fmt: skip
