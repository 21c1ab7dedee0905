"""Whether a recording, and what was identified from it, can carry a verdict at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.plausibility import objections_to_readings
from ehadiag.core.actuator import WEAR_EXCESS_FACTOR, Actuator, Calibration
from ehadiag.core.conversion import conversion_of
from ehadiag.core.criteria import FIT, LOSSES, READINGS, RECORDING
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.identification_result import Fit, Identification
from ehadiag.identify.prior import has_further_effects
from ehadiag.identify.signals import COMMAND_FRAME_TOLERANCE
from ehadiag.model.plant import REFERENCE_TEMPERATURE
from firmware_iface.recording import (
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
    for values in (
        samples.current,
        samples.spool,
        samples.pressure,
        samples.position,
        samples.command,
    ):
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
        *_gaps(
            samples,
            test,
            RECORDING.max_missing_share_without_counter
            if recording.by_time
            else RECORDING.max_missing_share,
        ),
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
    if test.closed_loop and commands < RECORDING.min_command_frames:
        if (
            np.isfinite(samples.current[: test.ticks]).mean()
            < RECORDING.min_current_share_without_command
        ):
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


def _gaps(samples: Samples, test: StoredTest, most: float) -> list[str]:
    out = []
    for name, values in (("spool", samples.spool), ("pressure", samples.pressure)):
        present = np.flatnonzero(np.isfinite(values[: test.ticks]))
        share = 1.0 - len(present) * _spacing(present) / test.ticks
        edges = np.concatenate([[-1], present, [test.ticks]])
        longest = float(np.diff(edges).max() - 1) / test.rate
        if share > most:
            out.append(f"{share:.0%} of the {name} samples are missing (limit {most:.0%})")
        elif longest > RECORDING.max_sample_gap_s:
            out.append(
                f"no {name} sample for {longest:.2f} s (limit {RECORDING.max_sample_gap_s:g} s)"
            )
    both = np.isfinite(samples.spool[: test.ticks]) & np.isfinite(samples.pressure[: test.ticks])
    spacing = _spacing(np.flatnonzero(both))
    for search in test.windows.__struct_fields__:
        for start, end in getattr(test.windows, search):
            inside = both[round(start * test.rate) : round(end * test.rate)]
            if (
                inside.sum() * spacing
                < RECORDING.min_sample_share_of_window * (end - start) * test.rate
            ):
                out.append(f"samples are missing in {start:g} … {end:g} s, which {search} needs")
    return out


def _spacing(present: NDArray[np.int64]) -> int:
    """Ticks between two samples: of a bus or a logger that brings each second tick none is lost."""
    steps = np.diff(present)
    return (
        int(np.clip(np.median(steps), 1, RECORDING.max_sample_spacing_ticks)) if steps.size else 1
    )


def objections_to_conditions(
    environment: Environment, samples: Samples, actuator: Actuator
) -> list[str]:
    """What the model must not be run with; holds for a running test too."""
    out = []
    saturated = conversion_of(samples, actuator).saturated
    for index, name in ((1, "spool"), (2, "pressure"), (3, "position")):
        share = float(np.mean(saturated[index]))
        if share > RECORDING.max_saturated_share:
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
        least = RECORDING.min_supply_pressure_share
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
    limit_lsb = max(
        RECORDING.max_control_residual_lsb, RECORDING.max_current_residual_stds * noise_lsb
    )
    if not trace.residual_lsb > limit_lsb:
        return ""
    return (
        f"servovalve current {trace.residual_lsb:.1f} LSB rms from what the "
        f"{'control law' if experiment.test.closed_loop else 'command'} gives (limit "
        f"{limit_lsb:.3g}): controller data wrong, or the current driver failed"
    )


def objections_to_estimate(
    identification: Identification, calibration: Calibration | None = None
) -> list[str]:
    """Why estimates cannot carry a verdict; empty if they can.

    calibration: of the unit: what it could not explain is no reason.
    """
    fit = identification.fit
    out = []
    rms = fit.unexplained_rms
    most_outliers, most_rms = residual_limits(calibration)
    if fit.unexplained_outliers > most_outliers or not rms <= most_rms:
        out.append(
            f"the model does not explain the recording: {fit.unexplained_outliers:.1%} of the "
            f"residuals beyond three times the noise (limit {most_outliers:.1%}), rms residual "
            f"{rms:.2f} (limit {most_rms:.3g}): other actuator data, or an effect that the three "
            "faults leave out"
        )
    if identification.ambiguous and not out:
        out.append(
            "searches with all effects of the unit leave more than noise in closed loop, where"
            " friction and hysteresis look alike: record the open-loop test, too"
        )
    if identification.better_exponent is not None:
        out.append(
            "the recording contradicts servovalve.clogging_exponent: with"
            f" {identification.better_exponent:g} far more of it is explained"
        )
    if out and identification.exponent_doubted:
        out.append("the recording does not bear out servovalve.clogging_exponent 0")
    hidden = [item.name for item in identification.estimates if not item.shown]
    if hidden:
        out.append(f"the test does not show {', '.join(hidden)}")
    return out


def is_explained_by_discrepancy_alone(fit: Fit, calibration: Calibration | None = None) -> bool:
    """Whether residuals beyond the limits are allowed for the discrepancy of the faults' laws.

    Effects of the unit that are estimated with them may stand for that discrepancy.
    """
    most_outliers, most_rms = residual_limits(calibration)
    return fit.outliers > most_outliers or not max(fit.spool_rms, fit.pressure_rms) <= most_rms


def residual_limits(calibration: Calibration | None) -> tuple[float, float]:
    """Outliers (share) and rms residual that an explained recording may have.

    calibration: of the unit: what it could not explain is allowed, and what wear brings out of
    effects that stand in for others.
    """
    if calibration is None:
        return FIT.max_outlier_share, FIT.max_rms
    further = has_further_effects(calibration)
    if not (further or calibration.fit.left > 0.0):
        return FIT.max_outlier_share, FIT.max_rms
    fit = calibration.fit
    outliers = (FIT.outlier_factor_further_effects if further else 1.0) * FIT.max_outlier_share
    return (
        min(outliers + WEAR_EXCESS_FACTOR * fit.outliers, FIT.max_outlier_share_poor_calibration),
        min(
            FIT.max_rms * WEAR_EXCESS_FACTOR * max(fit.spool_rms, fit.pressure_rms),
            FIT.max_rms_poor_calibration,
        ),
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
        if first >= RECORDING.min_missing_end_s:
            out.append(f"the first {first:.3f} s of the test are missing")
        if last >= RECORDING.min_missing_end_s:
            out.append(f"the last {last:.3f} s of the test are missing: the recording ends early")
        elif recording.outcome.state is BitState.RUNNING:
            out.append("the recording ends before the computer's word that the test is complete")
    return tuple(out)


def _plain_words(name: str) -> str:
    return name.lower().replace("_", " ")


def objection_to_lost_positions(experiment: Experiment) -> str:
    """Reason why a test's current cannot be rebuilt; empty if it can."""
    guessed = experiment.trace.guessed
    if guessed <= LOSSES.max_guessed_share:
        return ""
    return (
        f"{guessed:.1%} of the jack positions that the control law worked on are lost "
        f"(limit {LOSSES.max_guessed_share:.1%}) and not told by the response: the servovalve "
        f"current cannot "
        "be rebuilt"
    )


def objection_to_frame_order(recording: Recording) -> str:
    """Reason why the ticks of a recording's samples are uncertain; empty if they are not."""
    share = recording.out_of_order
    if not recording.by_time or share <= LOSSES.max_out_of_order_share:
        return ""
    return (
        f"by their time stamps {share:.0%} of the commands are of other ticks (limit "
        f"{LOSSES.max_out_of_order_share:.0%}): the frames have lost their order, and no counter "
        "tells it"
    )
