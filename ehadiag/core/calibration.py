"""What a calibration learned of one unit, as its actuator file keeps it."""

from __future__ import annotations

from typing import Annotated

import msgspec

__all__ = ["CHANGED", "NOISE_ALONE", "Calibration", "Goodness", "Source"]

MOST_PARAMETERS = 64
ROUNDING = 1e-9
NOISE_ALONE = 1.16
"""Excess up to which a model leaves nothing (`ehadiag.identify.nuisance.explained`)."""
CHANGED = 2.0
"""By which wear may make more of what a model leaves: friction acts on more of it."""

Text = Annotated[str, msgspec.Meta(max_length=1000)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
Size = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Root = Annotated[float, msgspec.Meta(ge=-1.1, le=1.1)]
Positive = Annotated[float, msgspec.Meta(ge=0, le=1e6)]


class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A recording that was learned from."""

    name: Text
    test: Name
    sha256: Annotated[str, msgspec.Meta(max_length=64)] = ""
    """Of the log; empty where it was none."""


class Goodness(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well the model explains the recordings with what was learned."""

    excess: Positive
    """Cost of the residuals over that of noise alone; about 1."""
    outliers: Positive
    """Share of residuals beyond three times the noise."""
    spool_rms: Positive
    """Residual in units of the noise."""
    pressure_rms: Positive

    @property
    def left(self) -> float:
        """What the model leaves beside noise, over what noise alone may leave; 0: nothing."""
        return max(self.excess / NOISE_ALONE - 1.0, 0.0)

    @property
    def most_excess(self) -> float:
        """Excess that a later recording of the unit may have."""
        return CHANGED * self.excess


class Calibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What was learned beside the data, which stand in the file's own tables."""

    date: Name
    """UTC, ISO 8601."""
    start: Name
    """Name of the actuator that it began with."""
    serial: Annotated[int, msgspec.Meta(ge=0, le=4294967295)] | None = None
    """Of the unit; None where its bus does not say."""
    plays: Annotated[int, msgspec.Meta(ge=1, le=256)] = 1
    """Of the hysteresis (PHY-29)."""
    effects: dict[str, Number]
    """Nuisances of the unit by name, SI."""
    parameters: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=MOST_PARAMETERS)]
    """What is not known exactly: effects, and data by their relative error."""
    std: tuple[Size, ...]
    """Standard deviations of the parameters, SI."""
    root: tuple[tuple[Root, ...], ...]
    """Lower triangle L of their correlation L Lᵀ, row by row."""
    held: dict[str, Text] = {}
    """What the recordings do not show: why it was held."""
    fit: Goodness
    evidence: dict[str, Number] = {}
    """Bayesian information criterion of each model that was tried, less the best one's; of open
    loop if there was one."""
    recordings: tuple[Source, ...]

    def objection(self) -> str:
        """Return what one key alone cannot tell; empty where all is well."""
        count = len(self.parameters)
        if len(set(self.parameters)) < count:
            return "calibration.parameters: a name stands twice"
        unknown = sorted(set(self.effects) - set(self.parameters))
        if unknown:
            return f"calibration.effects: {', '.join(unknown)} not among calibration.parameters"
        if len(self.std) != count:
            return f"calibration.std: need {count} numbers, one of each parameter"
        if [len(row) for row in self.root] != list(range(1, count + 1)):
            return f"calibration.root: need {count} rows of 1, 2, … numbers"
        if any(row[-1] < ROUNDING for row in self.root):
            return "calibration.root: the last number of a row must be above 0"
        return ""
