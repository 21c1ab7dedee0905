"""Converts the unit texts of a DBC to SI."""

from __future__ import annotations

from ehadiag.core.errors import ConfigurationError

__all__ = ["si_factor"]

UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "current": {"A": (1.0, 0.0), "mA": (1e-3, 0.0), "uA": (1e-6, 0.0)},
    "length": {
        "m": (1.0, 0.0),
        "cm": (1e-2, 0.0),
        "mm": (1e-3, 0.0),
        "um": (1e-6, 0.0),
        "in": (0.0254, 0.0),
        "mil": (25.4e-6, 0.0),
    },
    "pressure": {
        "Pa": (1.0, 0.0),
        "hPa": (1e2, 0.0),
        "kPa": (1e3, 0.0),
        "MPa": (1e6, 0.0),
        "mbar": (1e2, 0.0),
        "bar": (1e5, 0.0),
        "psi": (6894.757293168361, 0.0),
    },
    # Temperatures are kept in degC, the scale of the viscosity laws.
    "temperature": {
        "degC": (1.0, 0.0),
        "C": (1.0, 0.0),
        "K": (1.0, -273.15),
        "degF": (5.0 / 9.0, -160.0 / 9.0),
    },
    "time": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0)},
}
"""Per dimension: unit text -> (gain, bias), SI value = gain * value + bias."""

SPELLINGS = {
    "µA": "uA",
    "μA": "uA",
    "µm": "um",
    "μm": "um",
    "µs": "us",
    "μs": "us",
    "°C": "degC",
    "°F": "degF",
    "deg C": "degC",
    "deg F": "degF",
    "inch": "in",
    "Volts": "V",
    "sec": "s",
    "msec": "ms",
}


def si_factor(text: str, dimension: str, where: str) -> tuple[float, float]:
    """Gain and bias to SI of a unit text; `where` begins the error text.

    Parameters
    ----------
    text : str
        The unit as written.
    dimension : str
        Quantity that it must measure, a key of `UNITS`.
    where : str
        Beginning of the error message.

    Returns
    -------
    tuple[float, float]
        Gain and bias: SI value = gain · value + bias.

    Raises
    ------
    ConfigurationError
        No unit, or not one of the dimension.
    """
    known = UNITS[dimension]
    unit = SPELLINGS.get(text.strip(), text.strip())
    if unit in known:
        return known[unit]
    if not unit:
        raise ConfigurationError(
            f"{where}: the DBC gives no unit; add unit = … ({', '.join(known)}) to the mapping"
        )
    raise ConfigurationError(
        f"{where}: unit {text.strip()!r} is no {dimension} (known: {', '.join(known)})"
    )
