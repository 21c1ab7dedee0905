"""Progressive faults as data: the constant that each changes, and how well a test shows it.

This is the one table of severities: registry, first approximation, priors, monitor and exports
follow from it.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

from ehadiag.model.plant import ConstantValue, PlantConstants


class FaultLaw(NamedTuple):
    """What a severity does to the unit, and how well a test shows it."""

    short: str
    """In two words."""
    meaning: str
    """In a line."""
    constant: str
    """Field of `PlantConstants` that it changes."""
    limit: str
    """Field with the constant's value at the limit of damage; empty: `change` states it."""
    change: float
    """Relative change of the constant at the limit of damage, 1; 0 with `limit`."""
    first_search: Literal["jack", "slew", "creep"]
    """Response of the first approximation: pressure while the spool drives the jack, spool while
    it slews, or spool while it sticks and slips."""
    windows: str
    """Windows of a stored test in which the severity shows most."""
    precision: float
    """Typical error of the first approximation in proportion to those of the others, 1."""
    search_std: float
    """Standard deviation about the optimum of the search, 1."""
    ambiguous_std: float
    """Standard deviation, 1, in open loop with hardly any hysteresis: points near the optimum
    explain such recordings as well, the noise deciding which break-aways there were. Errors in 48
    of them (eight noises, six units) were 0.47, 0.19 and 0.02 % at most."""
    further_std: float
    """Standard deviation, 1, where a calibration learned effects beyond the usual ones, times the
    root of what its residuals leave beside noise: the effects' laws were seen on the unit as new,
    with a thirtieth of the friction at the limit of damage, and are held to when it is worn. With
    0.25 left errors of a recorded unit were up to 2.3, 1.4 and 0.9 %, with 0.09 up to 0.1, 0.2 and
    0.04 % (identification-results.md)."""
    needs_each_tick: bool
    """Whether only the response to single ticks of current shows it."""
    parts: tuple[str, ...]
    """Parts of a unit that end it when they are replaced."""
    pressure: str = ""
    """Field of a pressure gain that falls, too: by the share of `constant` that is left, to the
    power of the field `exponent` (PHY-45)."""
    exponent: str = ""


FAULT_LAWS: Final[dict[str, FaultLaw]] = {
    "Kintas": FaultLaw(
        short="filter clogging", meaning="clogging of the valve's first-stage filter",
        constant="GQF", limit="", change=-0.8, first_search="slew", windows="Kintas",
        precision=1.0, search_std=2e-3, ambiguous_std=2e-3, further_std=2.4e-2,
        needs_each_tick=True, parts=("filter", "valve"), pressure="GPF", exponent="CLE",
    ),
    "FSS": FaultLaw(
        short="spool friction", meaning="dry friction between spool and sleeve",
        constant="FSS", limit="FSS1", change=0.0, first_search="creep", windows="FSS",
        precision=1.0, search_std=1e-3, ambiguous_std=7e-4, further_std=4e-2,
        needs_each_tick=True, parts=("valve",),
    ),
    "FDJ": FaultLaw(
        short="jack friction", meaning="dry friction between jack and cylinder",
        constant="FDJ", limit="FDJ1", change=0.0, first_search="jack", windows="FDJ",
        precision=0.2, search_std=4e-4, ambiguous_std=5e-5, further_std=1e-2,
        needs_each_tick=False, parts=("jack",),
    ),
}  # fmt: skip
"""The progressive faults (PHY-13 to PHY-15), by name."""


def damaged_constant(
    new: ConstantValue, limit: ConstantValue, change: float, severity: ConstantValue
) -> ConstantValue:
    """Constant between that of a new unit and that at the limit of damage (PHY-13 to PHY-15).

    change: relative, 1; 0 where `limit` is the value at the limit of damage.
    """
    return new + severity * (limit - new) if change == 0.0 else new * (1.0 + change * severity)


FAULT_PLACES: Final[tuple[int, ...]] = tuple(
    PlantConstants._fields.index(law.constant) for law in FAULT_LAWS.values()
)
"""Place of each fault's constant in a row of constants."""
LIMIT_PLACES: Final[tuple[int, ...]] = tuple(
    PlantConstants._fields.index(law.limit or law.constant) for law in FAULT_LAWS.values()
)
"""Place of its value at the limit of damage; its own where the relative change states it."""
PRESSURE_PLACES: Final[tuple[int, ...]] = tuple(
    PlantConstants._fields.index(law.pressure) if law.pressure else -1
    for law in FAULT_LAWS.values()
)
"""Place of the pressure gain that falls with the constant; -1: none does."""
EXPONENT_PLACES: Final[tuple[int, ...]] = tuple(
    PlantConstants._fields.index(law.exponent) if law.exponent else -1
    for law in FAULT_LAWS.values()
)
FAULT_CHANGES: Final[tuple[float, ...]] = tuple(law.change for law in FAULT_LAWS.values())
SEARCH_STDS: Final[tuple[float, ...]] = tuple(law.search_std for law in FAULT_LAWS.values())


def doubling_severity(name: str, constants: PlantConstants) -> float:
    """Severity that changes a fault's constant by its size as new, 1; without sign."""
    law = FAULT_LAWS[name]
    if law.change:
        return 1.0 / abs(law.change)
    new = float(getattr(constants, law.constant))
    return new / (float(getattr(constants, law.limit)) - new)
