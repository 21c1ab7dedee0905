"""Plan of an exported library: what the actuator's data and its stored tests fix, as numbers."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence

import numpy as np

from ehadiag.assess.acceptance import residual_limits
from ehadiag.assess.verdict import Levels
from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import __version__
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.criteria import FIT, RECORDING, VERDICT
from ehadiag.identify.prior import DAILY_PRIORS, calibration_covariance, unit_prior
from ehadiag.model.plant import PLANT_FIELDS, PlantConstants, plant_constants
from ehadiag.model.registry import Unknowns, unit_constants
from ehadiag.monitor.monitor_memory import LibraryIdentity
from ehadiag.monitor.plan import CusumDesign, monitor_plan
from ehadiag.onboard.onboard_memory import (
    PLAN_IDENTITY,
    PLAN_TEST_SIZE,
    PLAN_WINDOWS,
    VerdictRules,
)
from firmware_iface.errors import ConfigurationError
from firmware_iface.stored_test import StoredTest, TimeWindow, bundled_tests

SMALLEST = {False: 2.0**-540, True: 2.0**-82}
"""Root of what makes of a pressure in Pa a number that is lost where small ones are flushed to
zero, by whether results are rounded to single precision, 1."""


def library_plan(
    actuator: Actuator,
    design: CusumDesign,
    tests: Sequence[StoredTest] | None = None,
    *,
    single: bool = False,
) -> Array:
    """Plan of a library, see `ehadiag.onboard.onboard_memory`.

    tests: one for each kind of commands, of which recordings are identified; None: the bundled
    ones. single: whether results are rounded to single precision. Two tests of one kind, or one at
    another rate than the actuator's, raise ConfigurationError.
    """
    begin = [*monitor_plan(actuator, unit_constants(actuator), design), *verdict_rules(actuator)]
    directions = [number for row in uncertain_constants(actuator) for number in row]
    end = [
        *_test_numbers(tests or tuple(bundled_tests().values()), actuator.controller.rate),
        float(len(directions) // PLANT_FIELDS),
        *directions,
    ]
    numbers = np.array([*begin, *end], dtype="<f8")
    # 48 bits: a double holds 53.
    digest = int.from_bytes(hashlib.sha256(numbers.tobytes()).digest()[:6], "big")
    return np.array([*begin, *identity_of(actuator, float(digest), single=single), *end])


def identity_of(actuator: Actuator, digest: float, *, single: bool = False) -> LibraryIdentity:
    """Identity of a library: digest of its plan."""
    major, minor, patch = (int(part) for part in re.findall(r"\d+", __version__)[:3])
    version = 1e6 * major + 1e3 * minor + patch
    serial = actuator.calibration.serial if actuator.calibration else None
    return LibraryIdentity(version, digest, float(serial or 0), SMALLEST[single])


def exported_unit(unit: Sequence[float], plan: Array) -> Array:
    """Return what C code hands to a library: a unit, and what the library's header says of it."""
    return np.array([*unit, *plan[PLAN_IDENTITY : PLAN_IDENTITY + 3]])


def uncertain_constants(actuator: Actuator) -> list[PlantConstants]:
    """Constants of a calibrated unit, a deviation off in each direction that is not certain.

    Columns of a root of the calibration's covariance, and what changes by the day.
    """
    calibration = actuator.calibration
    if calibration is None:
        return []
    base = plant_constants(actuator)._replace(NPL=float(calibration.plays))
    names, effects = calibration.parameters, calibration.effects
    root = np.linalg.cholesky(calibration_covariance(calibration))
    moved = [dict(zip(names, column, strict=True)) for column in root.T]
    moved += [{name: prior.std} for name, prior in DAILY_PRIORS.items()]
    return [
        Unknowns((), (base,), {**effects, **_sums(effects, item)}).constants(np.empty(0))
        for item in moved
    ]


def _sums(effects: Mapping[str, float], moved: Mapping[str, float]) -> dict[str, float]:
    return {name: effects.get(name, 0.0) + float(value) for name, value in moved.items()}


def _test_numbers(tests: Sequence[StoredTest], rate: float) -> list[float]:
    """Ticks and windows of the tests, in open loop first; zeros where there is none."""
    out: list[float] = []
    for closed in (False, True):
        mine = [item for item in tests if item.closed_loop is closed]
        if len(mine) > 1:
            names = ", ".join(item.name for item in mine)
            raise ConfigurationError(f"tests {names}: a library has one of each kind of commands")
        numbers = [0.0] * PLAN_TEST_SIZE
        for test in mine:
            if test.rate != rate:
                raise ConfigurationError(f"test {test.name}: rate {test.rate:g}, need {rate:g} Hz")
            windows = test.windows
            numbers = [float(test.ticks)]
            for search in (windows.FDJ, windows.Kintas, windows.FSS, windows.refinement):
                numbers += _window_numbers(search, rate)
        out += numbers
    return out


def _window_numbers(windows: Sequence[TimeWindow], rate: float) -> list[float]:
    """First tick and end of the longest windows, in their order, then zeros."""
    longest = sorted(windows, key=lambda span: span[0] - span[1])[:PLAN_WINDOWS]
    ticks = [float(round(time * rate)) for span in sorted(longest) for time in span]
    return [*ticks, *[0.0] * (2 * PLAN_WINDOWS - len(ticks))]


def verdict_rules(actuator: Actuator) -> VerdictRules:
    """Return the rules of a verdict on board: those of `ehadiag diagnose` at its default levels.

    What a calibration of the unit could not explain is no reason against a verdict.
    """
    levels, (outliers, rms) = Levels(), residual_limits(actuator.calibration)
    discrepancy = unit_prior(actuator).std if actuator.calibration else {}
    _, spool, pressure, position = (channel.ends for channel in actuator_channels(actuator))
    return VerdictRules(
        advisory=levels.advisory,
        limit=levels.limit,
        false_healthy=VERDICT.max_chance_false_healthy,
        fault_chance=VERDICT.min_chance_fault,
        most_outliers=outliers,
        most_rms=rms,
        search_outliers=max(FIT.max_fit_outliers, outliers - FIT.max_outlier_share),
        most_anchored=float(FIT.max_anchor_count),
        most_std=FIT.max_shown_std,
        most_lost=RECORDING.max_missing_share,
        longest_gap=RECORDING.max_sample_gap_s * actuator.controller.rate,
        most_saturated=RECORDING.max_saturated_share,
        least_supply=RECORDING.min_supply_pressure_share * actuator.servovalve.PSR,
        discrepancy_Kintas=discrepancy.get("Kintas", 0.0),
        discrepancy_FSS=discrepancy.get("FSS", 0.0),
        discrepancy_FDJ=discrepancy.get("FDJ", 0.0),
        spool_low=spool[0],
        spool_high=spool[1],
        pressure_low=pressure[0],
        pressure_high=pressure[1],
        position_low=position[0],
        position_high=position[1],
    )
