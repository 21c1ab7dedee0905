"""Verdicts, their levels and exit codes, and whether estimates can carry one."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum, StrEnum
from statistics import NormalDist
from typing import TYPE_CHECKING

import msgspec

from ehadiag.core.conventions import FRICTION_NAME
from ehadiag.core.criteria import FIT, VERDICT, rms_with_outliers
from firmware_iface.errors import ConfigurationError

if TYPE_CHECKING:  # the command line needs levels and codes long before it loads the compiler
    from ehadiag.core.actuator import Calibration
    from ehadiag.identify.identification_result import Estimate, Fit, Identification


class Verdict(IntEnum):
    """State of an actuator; the value is the exit code of the command line."""

    HEALTHY = 0
    DEGRADED = 10
    FAULT = 20
    NOT_TESTED = 30

    def __str__(self) -> str:
        """Return the name, as in the JSON result."""
        return self.name

    def __format__(self, specification: str) -> str:
        """Format the name."""
        return format(self.name, specification)


class VerdictRule(StrEnum):
    """What a verdict goes by."""

    INTERVAL = "interval"
    """The chance that a severity is at or above a level (JCGM 106:2012, section 8)."""
    ESTIMATE = "estimate"
    """The estimates alone."""


class Levels(msgspec.Struct, frozen=True):
    """Levels of a severity, 0 … 1, and the rule by which it is compared with them.

    Levels that are not 0 < advisory < limit <= 1 raise ConfigurationError.
    """

    advisory: float = VERDICT.advisory
    """DEGRADED at or above."""
    limit: float = VERDICT.limit
    """FAULT at or above."""
    rule: VerdictRule = VerdictRule.INTERVAL
    """What a verdict goes by."""

    def __post_init__(self) -> None:
        if not 0.0 < self.advisory < self.limit <= 1.0:
            raise ConfigurationError(
                f"levels: need 0 < advisory < limit <= 1, not {self.advisory:g} and {self.limit:g}"
            )


def judge(identification: Identification, levels: Levels) -> tuple[Verdict, tuple[str, ...]]:
    """Verdict on estimates that can carry one, and why.

    By the interval rule FAULT goes before NOT TESTED (a severity of which the test says nothing:
    its interval reaches from below the advisory level to above the limit), and that before
    DEGRADED. With a range of exponents of clogging friction makes a FAULT where it does with each
    of them; where it does with at least half of them the verdict is NOT TESTED.
    """
    if levels.rule is VerdictRule.ESTIMATE:
        return _by_estimate(identification.estimates, levels)
    share = _fault_share_of_exponents(identification, levels)
    sure = [
        item
        for item in identification.estimates
        if item.name != FRICTION_NAME or share in (0.0, 1.0)
    ]
    verdict, reasons = _by_estimate(sure, levels, faults_only=True)
    if reasons:
        return verdict, reasons
    words = _words_of_exponents(identification) if identification.frictions else ()
    if VERDICT.min_chance_fault <= share < 1.0:
        return Verdict.NOT_TESTED, words
    blind = [
        f"{item.name} may be anything from {item.interval95[0]:.3f} to {item.interval95[1]:.3f}"
        for item in identification.estimates
        if item.interval95[0] < levels.advisory and item.interval95[1] > levels.limit
    ]
    if blind:
        return Verdict.NOT_TESTED, (*blind, *words)
    verdict, reasons = _by_chance(identification.estimates, levels)
    return verdict, (*(words if share > 0.0 else ()), *reasons)


def _fault_share_of_exponents(identification: Identification, levels: Levels) -> float:
    """Share of the exponents of clogging with which the friction is a fault, 1."""
    frictions = identification.frictions
    return sum(value >= levels.limit for value in frictions) / max(len(frictions), 1)


def _words_of_exponents(identification: Identification) -> tuple[str, ...]:
    """Say what the friction may be by the exponents of clogging."""
    low, high = identification.named(FRICTION_NAME).interval95
    remedy = "check" if identification.exponent_doubted else "state"
    return (
        f"by the valve's exponent of clogging {FRICTION_NAME} may be {low:.3f} to {high:.3f}:"
        f" {remedy} servovalve.clogging_exponent",
    )


def _by_estimate(
    estimates: Sequence[Estimate], levels: Levels, *, faults_only: bool = False
) -> tuple[Verdict, tuple[str, ...]]:
    verdict, reasons = Verdict.HEALTHY, []
    for item in estimates:
        if _at_limit(item, levels):
            verdict = Verdict.FAULT
            reasons.append(f"{item.name} {item.value:.3f} at or above the limit {levels.limit:g}")
        elif item.value >= levels.advisory:
            verdict = max(verdict, Verdict.DEGRADED)
            reasons.append(_advisory(item, levels))
    if faults_only and verdict is not Verdict.FAULT:
        return Verdict.HEALTHY, ()
    return verdict, tuple(reasons)


def _at_limit(item: Estimate, levels: Levels) -> bool:
    if levels.rule is VerdictRule.ESTIMATE:
        return item.value >= levels.limit
    return chance_above(item, levels.limit) >= VERDICT.min_chance_fault


def _advisory(item: Estimate, levels: Levels) -> str:
    return f"{item.name} {item.value:.3f} at or above the advisory level {levels.advisory:g}"


def _by_chance(estimates: Sequence[Estimate], levels: Levels) -> tuple[Verdict, tuple[str, ...]]:
    """HEALTHY or DEGRADED, by the chance that any severity is at or above the advisory level.

    Chances are added (Boole's inequality): whatever the severities' correlation, theirs together is
    no greater.
    """
    chances = [chance_above(item, levels.advisory) for item in estimates]
    if sum(chances) <= VERDICT.max_chance_false_healthy:
        return Verdict.HEALTHY, ()
    worst = max(chances)
    reasons = [
        _advisory(item, levels)
        if item.value >= levels.advisory
        else f"{item.name} {item.value:.3f} may be at or above the advisory level "
        f"{levels.advisory:g}: chance {chance:.1%}"
        for item, chance in zip(estimates, chances, strict=True)
        if item.value >= levels.advisory
        or chance == worst
        or chance > VERDICT.max_chance_false_healthy
    ]
    return Verdict.DEGRADED, tuple(reasons)


def chance_above(item: Estimate, level: float) -> float:
    """Chance that a severity is at or above a level: of a normal density within 0 … 1."""
    if item.std <= 0.0:
        return float(item.value >= level)
    density = NormalDist(item.value, item.std)
    low, at, high = (density.cdf(x) for x in (0.0, level, 1.0))
    return (high - at) / (high - low) if high > low else float(item.value >= level)


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
    from ehadiag.identify.prior import has_further_effects  # noqa: PLC0415 - loads kernels

    further = has_further_effects(calibration)
    if not (further or calibration.fit.left > 0.0):
        return FIT.max_outlier_share, FIT.max_rms
    fit, most = calibration.fit, FIT.max_outlier_share_poor_calibration
    outliers = FIT.max_outlier_share + FIT.wear_excess_factor * fit.outliers
    rms = FIT.max_rms * FIT.wear_excess_factor * max(fit.spool_rms, fit.pressure_rms)
    return most if further else min(outliers, most), min(rms, rms_with_outliers(most))
