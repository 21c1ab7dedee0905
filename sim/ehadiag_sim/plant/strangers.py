"""Effects that no requirement names, to try the identification on the unknown."""

from __future__ import annotations

from dataclasses import dataclass

from ehadiag_sim.plant.checked import check_ranges, number

__all__ = ["Strangers"]


@dataclass(frozen=True, slots=True)
class Strangers:
    """What a bench may show and no requirement names: unknown to the identification, all 0 = none.

    Raises
    ------
    ConfigurationError: a value outside the range given beside it.
    """

    torque_cubic: float = number(0.0, -0.5, 0.5)
    """Torque GM·i·(1 + c·(i/IM)²), i behind hysteresis; -0.5 … 0.5, saturating iron is below 0."""
    play_skew: float = number(0.0, -10.0, 10.0)
    """Weights of the plays fall as exp(-k·(i + 0.5)/n) instead of being the same; -10 … 10."""
    driver_lag: float = number(0.0, 0.0, 5e-3)
    """Time constant of the current driver and its coil, s, 0 … 5e-3; the sensor sees what flows."""
    land_asymmetry: float = number(0.0, -0.5, 0.5)
    """Lands open by (1 + a) of the spool's travel to the plus side, (1 - a) to the other."""
    land_shift: float = number(0.0, -1e-4, 1e-4)
    """Spool position at which the lands are closed, m, ±1e-4."""
    spool_bend_2: float = number(0.0, -0.3, 0.3)
    """Spool sensor reads x·(1 + a·x/XSM + b·(x/XSM)²): a, -0.3 … 0.3."""
    spool_bend_3: float = number(0.0, -0.3, 0.3)
    """And b."""
    jack_bend_2: float = number(0.0, -0.3, 0.3)
    """The same for the jack sensor and XJM."""
    jack_bend_3: float = number(0.0, -0.3, 0.3)
    oil_drift: float = number(0.0, -20.0, 20.0)
    """The oil warms by so many K/s during the test, -20 … 20."""
    friction_asymmetry: float = number(0.0, -0.9, 0.9)
    """Jack friction (1 + a) when it moves out, (1 - a) when it moves in."""
    spool_friction_slope: float = number(0.0, -0.9, 0.9)
    """Spool friction grows along the sleeve: × (1 + a·XS/XSM)."""

    def __post_init__(self) -> None:
        check_ranges(self, "stranger")
