"""Describes the response of a recording: measured beside modelled, or beside that of a unit as new.

With the events of the modelled motion (break-aways, reversals, end stops), the parts of the test
that the searches use, spans without samples, and spans in which measured and expected differ.
"""

from __future__ import annotations

import contextlib
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis
from ehadiag.calibration.unit_models import Calibrated
from ehadiag.core.actuator import Actuator
from ehadiag.identify.experiment import ANCHOR_THRESHOLDS_LSB, Experiment, build_experiment
from ehadiag.model.plant import PlantConstants
from ehadiag.model.residual_models import model_response
from ehadiag.model.sensors import SensorLaw, sensor_law
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.report.head import head_of, stored_test_name
from ehadiag.report.picture import (
    Band,
    Curve,
    CurveValues,
    Panel,
    Picture,
    PictureColumn,
    marked_spans,
)
from ehadiag.result import Origin, Result
from firmware_iface.errors import printable
from firmware_iface.recording import CommandMode, Recording, Samples
from firmware_iface.stored_test import RATE_TOLERANCE, StoredTest

QUIET_TIME_S = 0.02
"""Time, s, without a re-anchoring that parts two runs of them: a model that is off is put back
at almost every tick."""

MotionEvents = dict[str, NDArray[np.intp]]
"""Ascending ticks of a body's break-aways, reversals without a rest, and arrivals at a stop; and
those from which on the model would be put back on the measured spool."""


def motion_events(place: CurveValues, stop: float) -> MotionEvents:
    """Find the events of a modelled motion (m) between two end stops (m), by their roles.

    The model holds a body that rests exactly where it is, so two equal neighbours are a rest. A
    body within a nanometre of its stop is on it.
    """
    stopped = np.abs(place) >= stop - 1e-9
    way = np.sign(np.diff(place))
    before, after = way[:-1], way[1:]
    return {
        "break-away": np.flatnonzero((before == 0.0) & (after != 0.0) & ~stopped[1:-1]) + 1,
        "reversal": np.flatnonzero(before * after < 0.0) + 1,
        "end stop": np.flatnonzero(stopped[1:] & ~stopped[:-1]) + 1,
    }


def sensed_response(
    experiment: Experiment, constants: PlantConstants
) -> tuple[CurveValues, CurveValues, CurveValues]:
    """Run the model from rest, and read its response by sensors with these errors.

    constants: of the actuator, with the offsets and gains of its sensors. Returns spool (m),
    differential pressure (Pa) and jack position (m), shape (ticks,) each.
    """
    current = experiment.trace.current
    model = model_response(constants, current, experiment.tick, origin=experiment.origin)
    law = _sensor_law(constants)
    bent = model.spool * (law.spool_even + law.spool_odd * model.spool)
    return (
        law.spool_offset + model.spool * (law.spool_gain + bent),
        law.pressure_offset + law.pressure_gain * model.pressure,
        law.position_offset + law.position_gain * model.position,
    )


def _sensor_law(constants: PlantConstants) -> SensorLaw:
    """As the function is written: compiled for this one call it would take half a second."""
    law: SensorLaw = sensor_law(constants)
    return law


class ResponseSignal(msgspec.Struct, frozen=True):
    """A signal of a response, as people read it."""

    key: str
    name: str
    unit: str
    small_unit: str
    factor: float
    """From SI."""


RESPONSE_SIGNALS = (
    ResponseSignal("current", "servovalve current", "mA", "µA", 1e3),
    ResponseSignal("spool", "spool position", "mm", "µm", 1e3),
    ResponseSignal("pressure", "differential pressure", "MPa", "kPa", 1e-6),
    ResponseSignal("position", "jack position", "mm", "µm", 1e3),
)


def modelled_column(
    experiment: Experiment, constants: PlantConstants, recording: Recording
) -> PictureColumn:
    """Describe the response of the model, with constants as identified, beside the measured."""
    assert recording.samples is not None
    spool, pressure, position = sensed_response(experiment, constants)
    law, trace = _sensor_law(constants), experiment.trace
    current = recording.samples.current[: experiment.ticks] - trace.offset
    moving = {
        "spool": ((spool - law.spool_offset) / law.spool_gain, float(constants.XSM)),
        "position": ((position - law.position_offset) / law.position_gain, float(constants.XJM)),
    }
    measured = (current, experiment.spool, experiment.pressure, experiment.position)
    modelled = (trace.current, spool, pressure, position)
    curves = {
        signal.key: Curve("modelled", "modelled", values)
        for signal, values in zip(RESPONSE_SIGNALS, modelled, strict=True)
    }
    events = {key: motion_events(*motion) for key, motion in moving.items()}
    events["spool"]["re-anchoring"] = _reanchorings(experiment, constants)
    tick, test = experiment.tick, experiment.test
    column = _column("Measured and modelled", recording, measured, curves, tick, test, events)
    offsets = (
        trace.offset, experiment.spool_offset, experiment.pressure_offset,
        experiment.position_offset,
    )  # fmt: skip
    rows = zip(RESPONSE_SIGNALS, column.panels, offsets, (None, *experiment.noise), strict=True)
    panels = (
        replace(
            panel, offset=offset * signal.factor, noise=None if std is None else std * signal.factor
        )
        for signal, panel, offset, std in rows
    )
    return replace(column, panels=tuple(panels))


def _reanchorings(experiment: Experiment, constants: PlantConstants) -> NDArray[np.intp]:
    """Find the ticks at which re-anchorings begin, each more than `QUIET_TIME_S` after the last."""
    ticks = model_response(
        constants, experiment.trace.current, experiment.tick, origin=experiment.origin,
        measured=experiment.spool, anchor=experiment.anchor(ANCHOR_THRESHOLDS_LSB),
    ).anchored  # fmt: skip
    quiet = round(QUIET_TIME_S / experiment.tick)
    return ticks[np.diff(ticks, prepend=-quiet - 1) > quiet]


def _expected_column(
    recording: Recording, samples: Samples, test: StoredTest | None, actuator: Actuator
) -> PictureColumn:
    """Describe a response without an estimate beside its command and that of a unit as new."""
    curves = {}
    for key, values in _expected_curves(recording, samples, test, actuator).items():
        label = "command" if key in ("current", "position") else "expected of a unit as new"
        curves[key] = Curve(label, "modelled", values)
    measured = [getattr(samples, signal.key) for signal in RESPONSE_SIGNALS]
    tick = samples.period_ns * 1e-9
    return _column("Measured and expected", recording, measured, curves, tick, test, {})


def _column(
    title: str,
    recording: Recording,
    measured: Sequence[CurveValues],
    others: Mapping[str, Curve],
    tick: float,
    test: StoredTest | None,
    events: Mapping[str, MotionEvents],
) -> PictureColumn:
    """Describe measured signals and what each is compared with, SI."""
    end = len(measured[0]) * tick
    planned = end if test is None else max(end, test.duration)
    time = np.arange(len(measured[0]), dtype=np.float64) * tick
    panels = []
    for signal, values in zip(RESPONSE_SIGNALS, measured, strict=True):
        curves = [Curve("measured", "measured", values * signal.factor)]
        spans = [*marked_spans(~np.isfinite(values), tick), *([(end, planned)] * (planned > end))]
        bands = [Band(*span, "missing") for span in spans]
        other = others.get(signal.key)
        if other is not None:
            line = Curve(other.label, other.role, other.y * signal.factor)
            curves.append(line)
            for event, ticks in events.get(signal.key, {}).items():
                if ticks.size:
                    curves.append(Curve(event, event, line.y[ticks], time[ticks]))
            if other.label == "expected of a unit as new":
                parts = marked_spans(_deviates(values, other.y), tick)
                bands += [Band(*span, "deviation") for span in parts]
        panels.append(
            Panel(
                signal.name, signal.unit, time, tuple(curves), tuple(bands),
                small_unit=signal.small_unit,
            )
        )  # fmt: skip
    details = printable(stored_test_name(None if test is None else test.name))
    roles = {band.role for panel in panels for band in panel.bands}
    if "missing" in roles:
        details += ", grey: no samples"
    if "deviation" in roles:
        details += ", red: measured and expected differ"
    return PictureColumn(
        title,
        tuple(panels),
        "time, s",
        details=details,
        x_range=(0.0, planned),
        parts=() if test is None else _test_parts(test),
        source=printable(recording.source),
    )


def _test_parts(test: StoredTest) -> tuple[Band, ...]:
    """Parts of the test in the order of time, named by the searches that use them."""
    windows = test.windows
    used = {name: getattr(windows, law.windows) for name, law in FAULT_LAWS.items()}
    used["search"] = windows.refinement
    names: dict[tuple[float, float], list[str]] = {}
    for name, spans in used.items():
        for span in spans:
            names.setdefault(span, []).append(name)
    labels = {span: ", ".join(names[span]) for span in sorted(names)}
    order = list(dict.fromkeys(labels.values()))  # parts of one label have one colour
    return tuple(
        Band(*span, f"part {order.index(label) % 3}", label) for span, label in labels.items()
    )


def _expected_curves(
    recording: Recording, samples: Samples, test: StoredTest | None, actuator: Actuator
) -> dict[str, CurveValues]:
    """Return command and response of a unit as new, SI, as far as the recording determines them."""
    if test is None or abs(samples.period_ns * 1e-9 * test.rate - 1.0) > RATE_TOLERANCE:
        return {}
    closed = samples.mode is CommandMode.POSITION
    if test.closed_loop != closed:
        return {}
    out = {"position" if closed else "current": test.command()}
    # The response needs the current of most ticks; of a recording unlike its test there is none.
    if np.isfinite(samples.current).mean() >= 0.5:
        with contextlib.suppress(ValueError, IndexError, ZeroDivisionError):
            experiment = build_experiment(samples, recording.environment, test, actuator)
            constants, current = experiment.constants, experiment.trace.current
            response = model_response(constants, current, experiment.tick)
            out |= {"spool": response.spool, "pressure": response.pressure}
    return {key: _padded(values, samples.ticks) for key, values in out.items()}


def _padded(values: CurveValues, ticks: int) -> CurveValues:
    out = np.full(ticks, np.nan)
    out[: min(len(values), ticks)] = values[:ticks]
    return out


def _deviates(measured: CurveValues, model: CurveValues) -> NDArray[np.bool_]:
    """Where a signal, less a constant, is off by more than 5 % of the largest expected value."""
    gap = measured - model
    present = np.isfinite(gap)
    if not present.any():
        return present
    largest = np.nanmax(np.abs(model)) or 1.0
    return present & (np.abs(gap - np.median(gap[present])) > 0.05 * largest)


def response_columns(diagnosis: Diagnosis) -> Iterator[tuple[Recording, PictureColumn]]:
    """Describe the response of each recording: modelled if there are estimates, else expected."""
    found = diagnosis.identification
    if found is not None and all(math.isfinite(item.value) for item in found.estimates):
        pairs = zip(diagnosis.experiments, diagnosis.recordings, strict=False)
        for experiment, recording in pairs:
            constants = found.constants(experiment.constants)
            yield recording, modelled_column(experiment, constants, recording)
    else:
        for recording, test in zip(diagnosis.recordings, diagnosis.tests, strict=True):
            if recording.samples is not None and recording.samples.ticks:
                column = _expected_column(recording, recording.samples, test, diagnosis.actuator)
                yield recording, column


def result_picture(result: Result) -> Picture:
    """Describe the picture of a result that can be drawn; its title says what was diagnosed."""
    columns = tuple(column for _, column in response_columns(result.diagnosis))
    return Picture("\n".join(_title(result, len(columns))), columns)


def _title(result: Result, columns: int) -> list[str]:
    head = head_of(result)
    lines = [head.title]
    for text in head.lines:
        lines += textwrap.wrap(printable(text), 110 * columns)
    if not result.relied_on:
        lines.append(head.best_fit)
    elif result.identified:
        faults = (
            f"{item.name} {item.value:.5f} ({item.interval[0]:.5f} … {item.interval[1]:.5f})"
            for item in result.severities.values()
        )
        lines.append(",  ".join(faults))
    if result.other:
        effects = (
            f"{item.meaning} {item.shown(item.value or 0.0):.3g} {item.shown_unit}"
            f"{' beyond its limit' if item.beyond else ''}"
            for item in result.other
        )
        lines.append(",  ".join(effects))
    facts = ", ".join(f"{label} {printable(value)}".lstrip() for label, value in head.facts)
    return [*lines, *textwrap.wrap(f"{facts}, {_names(result.origins)}", 110 * columns)]


def _names(recordings: Sequence[Recording | Origin]) -> str:
    return " + ".join(printable(Path(recording.source).name) for recording in recordings)


def calibration_columns(found: Calibrated) -> Iterator[PictureColumn]:
    """Describe the response of each recording that a calibration was fitted to."""
    for experiment, recording in zip(found.experiments, found.recordings, strict=False):
        yield modelled_column(experiment, experiment.constants, recording)


def calibration_picture(found: Calibrated) -> Picture:
    """Describe the picture of a calibration that has experiments."""
    state = "CALIBRATED" if found.actuator else "NOT CALIBRATED"
    return Picture(f"{state}: {_names(found.recordings)}", tuple(calibration_columns(found)))
