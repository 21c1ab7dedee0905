"""State of a simulated actuator: its faults, its effects, and the errors of its sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from ehadiag.core.errors import ConfigurationError

__all__ = ["Effects", "Faults", "Sensors"]


@dataclass(frozen=True, slots=True)
class Faults:
    """The three progressive faults (model.md section 3), each 0 (as new) … 1 (limit of damage).

    Raises
    ------
    ConfigurationError: a constant outside 0 … 1.
    """

    Kintas: float = 0.0
    """Clogging of the servovalve first-stage filter."""
    FSS: float = 0.0
    """Dry friction between spool and sleeve."""
    FDJ: float = 0.0
    """Dry friction between jack and cylinder."""

    def __post_init__(self) -> None:
        for item in fields(self):
            _within(f"fault {item.name}", getattr(self, item.name), 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Effects:
    """What the three faults leave out (model.md section 4).

    Raises
    ------
    ConfigurationError: a value outside the range given beside it.
    """

    hysteresis: float = 0.0
    """Torque-motor hysteresis: width of the loop as a fraction of rated current, 0 … 1."""
    gain_change: float = 0.0
    """Relative change of the torque-motor gain, -0.9 … 1."""
    backlash: float = 0.0
    """Half-width of the play between spool and feedback-spring ball, m, 0 … 1e-3."""
    oil_temperature: float = 40.0
    """degC, -54 … 205: the range of MIL-PRF-83282."""
    supply_pressure: float = 20.7e6
    """Pa, above the return pressure, at most 100 MPa."""
    return_pressure: float = 0.7e6
    """Pa, 0 … 100 MPa."""

    def __post_init__(self) -> None:
        _within("effect hysteresis", self.hysteresis, 0.0, 1.0)
        _within("effect gain_change", self.gain_change, -0.9, 1.0)
        _within("effect backlash (m)", self.backlash, 0.0, 1e-3)
        _within("oil temperature (degC)", self.oil_temperature, -54.0, 205.0)
        _within("return pressure (Pa)", self.return_pressure, 0.0, 100e6)
        _within("supply pressure (Pa)", self.supply_pressure, 0.0, 100e6)
        if self.supply_pressure <= self.return_pressure:
            raise ConfigurationError("supply pressure must be greater than return pressure")


@dataclass(frozen=True, slots=True)
class Sensors:
    """How the four converters err (model.md section 5), in LSB of each channel.

    Raises
    ------
    ConfigurationError: noise negative or above 100 LSB, an offset beyond 4096 LSB.
    """

    noise_lsb: float = 0.5
    """Electrical noise before conversion, rms."""
    offsets_lsb: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Constant offset of current, spool, pressure, position."""

    def __post_init__(self) -> None:
        _within("sensor noise (LSB)", self.noise_lsb, 0.0, 100.0)
        if len(self.offsets_lsb) != 4:
            raise ConfigurationError(f"sensor offsets: need 4 values, not {len(self.offsets_lsb)}")
        for value in self.offsets_lsb:
            _within("sensor offset (LSB)", value, -4096.0, 4096.0)


def _within(what: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigurationError(f"{what}: {value:g} is outside {low:g} … {high:g}")
