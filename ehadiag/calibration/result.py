"""What a calibration gives: the unit's actuator data, what was learned, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass

from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment

__all__ = ["Calibrated", "Severity", "Tried", "Value"]


@dataclass(frozen=True, slots=True)
class Value:
    """One thing that was learned of the unit; SI."""

    name: str
    """Of the parameter."""
    symbol: str
    meaning: str
    unit: str
    start: float
    """Of the actuator file that it began with."""
    value: float
    std: float
    shown: bool
    """Whether the recordings show it: else little is known but its usual size."""


@dataclass(frozen=True, slots=True)
class Severity:
    """A severity as the recordings show it, where it is not taken for 0."""

    name: str
    value: float
    std: float


@dataclass(frozen=True, slots=True)
class Tried:
    """A model that was tried."""

    words: str
    excess: float
    """Cost of its residuals, in open loop if there was one, over that of noise alone."""
    criterion: float
    """Bayesian information criterion, less the best one's."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """A calibration, or why there is none."""

    recordings: tuple[Recording, ...]
    tests: tuple[StoredTest | None, ...]
    start: Actuator
    actuator: Actuator | None
    """The unit's data with its `calibration`; None where it was refused."""
    reasons: tuple[str, ...]
    """Why it was refused."""
    notes: tuple[str, ...]
    severities: tuple[Severity, ...]
    values: tuple[Value, ...]
    tried: tuple[Tried, ...]
    experiments: tuple[Experiment, ...]
    """What was learned from, with the unit's own constants; empty where nothing was."""
    seed: int
    evaluations: int
    """Runs of the model."""
    elapsed: float
    """s."""
