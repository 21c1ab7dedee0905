"""Puts what was learned into an actuator's data: values, covariance, what was held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.calibration.result import Value
from ehadiag.core.actuator import Actuator, Tolerance
from ehadiag.core.calibration import Calibration, Goodness, Source
from ehadiag.identify.estimates import fit_of
from ehadiag.identify.nuisance.estimate import Estimated
from ehadiag.identify.nuisance.knowledge import MOTOR_GAIN, OF_THE_DAY
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULTS, OFFSETS, Parameter

__all__ = ["Lesson", "lesson_of", "unit_of", "values_of"]

OTHER_SYMBOLS = {MOTOR_GAIN: "GM", "bulk_modulus": "beta"}
"""Keys of data whose parameter has another name."""
UNITS = {
    "GM": "N m/A",
    "KF": "N m/m",
    "KSF": "N m/m",
    "CS": "N s/m",
    "FSS0": "N",
    "GP": "Pa/m",
    "GQ": "m²/s",
    "MJ": "kg",
    "CJ": "N s/m",
    "FDJ0": "N",
    "beta": "Pa",
}
"""SI units of the data that are learned."""
SHOWN = 0.7
"""Of the deviation known beforehand: what has become no narrower was not shown."""
HARDLY = "the recordings hardly show it: little is known but its usual size"


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """What was learned of the unit's own parameters.

    Attributes
    ----------
    parameters : tuple[Parameter, ...]
        What the unit keeps over its life.
    values : NDArray[np.float64]
        SI, data by their relative error, shape (k,).
    covariance : NDArray[np.float64]
        Shape (k, k).
    before : NDArray[np.float64]
        Deviations of what was known beforehand, shape (k,).
    """

    parameters: tuple[Parameter, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    before: NDArray[np.float64]

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviations, shape (k,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def shown(self) -> list[bool]:
        """What the recordings show."""
        return [bool(item) for item in self.std < SHOWN * self.before]


def lesson_of(found: Estimated, before: Mapping[str, float]) -> Lesson:
    """Take out what the unit keeps: no severity, nor what each recording shows of its day.

    before: deviations of what was known beforehand, by name.
    """
    refined = found.refined
    apart = {*OF_THE_DAY, *(item.name for item in (*FAULTS, *OFFSETS))}
    kept = [k for k, item in enumerate(refined.parameters) if item.name not in apart]
    items = tuple(refined.parameters[k] for k in kept)
    spread = covariance(refined) + found.covariance
    return Lesson(
        parameters=items,
        values=(refined.x * refined.scale)[kept],
        covariance=spread[np.ix_(kept, kept)],
        before=np.array([before[item.name] for item in items]),
    )


def unit_of(
    start: Actuator,
    lesson: Lesson,
    found: Estimated,
    *,
    plays: int,
    date: str,
    serial: int | None,
    sources: Sequence[Source],
    evidence: Mapping[str, float],
) -> Actuator:
    """Return the unit's data with its calibration.

    start: its data with the class of second stage that was chosen; where it is calibrated itself
    the lesson is of deviations from it.
    """
    about = start.calibration.effects if start.calibration else {}
    effects, changes = dict(about), {}
    std = lesson.std.copy()
    for k, item in enumerate(lesson.parameters):
        value = float(lesson.values[k])
        symbol = _symbol(item)
        if symbol is None:
            effects[item.name] = about.get(item.name, 0.0) + value
        else:
            changes[symbol] = 1.0 + value
            std[k] /= 1.0 + value
    correlation = lesson.covariance / np.outer(lesson.std, lesson.std)
    fit = fit_of(found.refined, found.experiments)
    calibration = Calibration(
        date=date,
        start=start.calibration.start if start.calibration else start.name,
        serial=serial,
        plays=plays,
        effects=effects,
        parameters=tuple(item.name for item in lesson.parameters),
        std=tuple(std.tolist()),
        root=_root(correlation),
        held={
            item.name: HARDLY
            for item, shown in zip(lesson.parameters, lesson.shown, strict=True)
            if not shown
        },
        fit=Goodness(
            excess=found.excess,
            outliers=fit.outliers,
            spool_rms=fit.spool_rms,
            pressure_rms=fit.pressure_rms,
        ),
        evidence=dict(evidence),
        recordings=tuple(sources),
    )
    return msgspec.structs.replace(
        start,
        servovalve=_changed(start.servovalve, changes),
        jack=_changed(start.jack, changes),
        second_stage=_changed(start.second_stage, changes),
        tolerance=Tolerance(),
        calibration=calibration,
    )


def values_of(start: Actuator, unit: Actuator, lesson: Lesson) -> tuple[Value, ...]:
    """Rows of a table: what was learned, beside what the first file said."""
    out = []
    about = start.calibration.effects if start.calibration else {}
    effects = unit.calibration.effects if unit.calibration else {}
    for item, std, shown in zip(lesson.parameters, lesson.std.tolist(), lesson.shown, strict=True):
        symbol = _symbol(item)
        if symbol is None:
            before, value = about.get(item.name, 0.0), effects[item.name]
        else:
            before, value = _datum(start, symbol), _datum(unit, symbol)
        out.append(
            Value(
                name=item.name,
                symbol=symbol or item.symbol,
                meaning=item.short,
                unit=item.unit if symbol is None else UNITS[symbol],
                start=before,
                value=value,
                std=std if symbol is None else std * before,
                shown=shown,
            )
        )
    return tuple(out)


def _symbol(item: Parameter) -> str | None:
    """Key of the datum that a parameter is the relative error of."""
    if item.name in OTHER_SYMBOLS:
        return OTHER_SYMBOLS[item.name]
    return item.name.removeprefix("datum_") if item.name.startswith("datum_") else None


def _datum(actuator: Actuator, symbol: str) -> float:
    parts = (actuator.servovalve, actuator.jack, actuator.second_stage)
    return float(next(getattr(part, symbol) for part in parts if hasattr(part, symbol)))


def _changed(part: msgspec.Struct, factors: Mapping[str, float]) -> msgspec.Struct:
    mine = {name: factor for name, factor in factors.items() if hasattr(part, name)}
    return msgspec.structs.replace(
        part, **{name: getattr(part, name) * factor for name, factor in mine.items()}
    )


def _root(correlation: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    """Lower triangle of the correlation, row by row."""
    lower = np.linalg.cholesky(correlation)
    return tuple(tuple(row[: k + 1].tolist()) for k, row in enumerate(lower))
