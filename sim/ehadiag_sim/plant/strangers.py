"""Simulated effects outside the requirements, which the identification is not told about."""

from __future__ import annotations

from dataclasses import dataclass

from ehadiag_sim.plant.checked import check_ranges, number

__all__ = ["Strangers"]


@dataclass(frozen=True, slots=True)
class Strangers:
    """What a bench may show and no requirement names: unknown to the identification, all 0 = none.

    Attributes
    ----------
    torque_cubic : float
        Torque GM·i·(1 + c·(i/IM)²), i behind hysteresis; -0.5 … 0.5, saturating iron is below
        0.
    play_skew : float
        Weights of the plays fall as exp(-k·(i + 0.5)/n) instead of being the same; -10 … 10.
    driver_lag : float
        Time constant of the current driver and its coil, s, 0 … 5e-3; the sensor sees what
        flows.
    land_asymmetry : float
        Lands open by (1 + a) of the spool's travel to the plus side, (1 - a) to the other.
    land_shift : float
        Spool position at which the lands are closed, m, ±1e-4.
    spool_bend_2 : float
        Spool sensor reads x·(1 + a·x/XSM + b·(x/XSM)²): a, -0.3 … 0.3.
    spool_bend_3 : float
        And b.
    jack_bend_2 : float
        The same for the jack sensor and XJM.
    jack_bend_3 : float
        And b.
    oil_drift : float
        The oil warms by so many K/s during the test, -20 … 20.
    friction_asymmetry : float
        Jack friction (1 + a) when it moves out, (1 - a) when it moves in.
    spool_friction_slope : float
        Spool friction grows along the sleeve: × (1 + a·XS/XSM).

    Raises
    ------
    ConfigurationError
        A value outside the range given beside it.
    """

    torque_cubic: float = number(0.0, -0.5, 0.5)
    play_skew: float = number(0.0, -10.0, 10.0)
    driver_lag: float = number(0.0, 0.0, 5e-3)
    land_asymmetry: float = number(0.0, -0.5, 0.5)
    land_shift: float = number(0.0, -1e-4, 1e-4)
    spool_bend_2: float = number(0.0, -0.3, 0.3)
    spool_bend_3: float = number(0.0, -0.3, 0.3)
    jack_bend_2: float = number(0.0, -0.3, 0.3)
    jack_bend_3: float = number(0.0, -0.3, 0.3)
    oil_drift: float = number(0.0, -20.0, 20.0)
    friction_asymmetry: float = number(0.0, -0.9, 0.9)
    spool_friction_slope: float = number(0.0, -0.9, 0.9)

    def __post_init__(self) -> None:
        check_ranges(self, "stranger")
