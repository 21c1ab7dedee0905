"""Units in which people read what is in SI: mA for A, % for a share."""

from __future__ import annotations

__all__ = ["factor_and_unit", "told"]

SHOWN_IN = {
    "A": (1e3, "mA"),
    "m": (1e6, "µm"),
    "s": (1e3, "ms"),
    "1": (1e2, "%"),
    "m/s": (1e3, "mm/s"),
    "N/m": (1e-3, "N/mm"),
    "N m/A": (1.0, "N mm/mA"),
    "Pa": (1e-6, "MPa"),
    "Pa/m": (1e-9, "MPa/mm"),
    "m²/s": (60.0, "L/min/mm"),
}
"""Factor and unit by the SI unit; others are shown as they are."""
SMALL_PRESSURE = 1e5
"""Pa, below which a pressure is read in kPa."""


def factor_and_unit(unit: str, size: float) -> tuple[float, str]:
    """Return what turns a number in an SI unit into one for people, and the unit of that.

    Parameters
    ----------
    unit : str
        SI unit; `1` for a share.
    size : float
        The number, or the largest of those that are to be shown together.

    Returns
    -------
    tuple[float, str]
        Factor and unit.
    """
    if unit == "Pa" and abs(size) < SMALL_PRESSURE:
        return 1e-3, "kPa"
    return SHOWN_IN.get(unit, (1.0, unit))


def told(value: float, unit: str) -> str:
    """Write a number with the unit that people read.

    Parameters
    ----------
    value : float
        In the SI unit.
    unit : str
        SI unit; `1` for a share.

    Returns
    -------
    str
        Such as `0.4 mA`.
    """
    factor, name = factor_and_unit(unit, value)
    return f"{factor * value:.4g} {name}"
