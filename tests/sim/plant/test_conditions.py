import math

import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag_sim.plant.coefficients import coefficients, relative_viscosity
from ehadiag_sim.plant.conditions import Effects, Faults, Sensors


@pytest.mark.parametrize(
    ("build", "names"),
    [
        (lambda: Faults(Kintas=1.01), "Kintas"),
        (lambda: Faults(FSS=-0.1), "FSS"),
        (lambda: Faults(FDJ=math.nan), "FDJ"),
        (lambda: Effects(hysteresis=2.0), "hysteresis"),
        (lambda: Effects(backlash=-1e-6), "backlash"),
        (lambda: Effects(gain_change=-2.1), "gain_change"),
        (lambda: Effects(oil_temperature=-100.0), "temperature"),
        (lambda: Effects(supply_pressure=0.5e6, return_pressure=0.7e6), "supply"),
        (lambda: Sensors(noise_lsb=-1.0), "noise"),
        (lambda: Sensors(offsets_lsb=(0.0, 0.0, 0.0)), "4 values"),
        (lambda: Sensors(offsets_lsb=(0.0, 0.0, math.inf, 0.0)), "offset"),
    ],
)
def test_out_of_range_is_refused_by_name(build, names):
    with pytest.raises(ConfigurationError, match=names):
        build()


def test_viscosity_goes_through_the_two_known_points():
    assert relative_viscosity(40.0) == pytest.approx(1.0)
    assert relative_viscosity(100.0) == pytest.approx(3.5 / 14.5)
    # The recording at 85 degC states 0.317; a datasheet of this oil about 2000 mm²/s at -40 degC.
    assert relative_viscosity(85.0) == pytest.approx(0.317, abs=5e-4)
    assert relative_viscosity(-40.0) > 50.0


def test_faults_scale_as_the_contract_says():
    actuator = default_actuator()
    valve, jack = actuator.servovalve, actuator.jack
    p = coefficients(actuator, Faults(0.5, 0.25, 1.0), Effects())
    assert pytest.approx(valve.GQF * 0.6) == valve.AS**2 * valve.GPF / (p.DAMPING - valve.CS)
    assert pytest.approx(2.0 + 0.25 * 58.0) == p.FSS
    assert pytest.approx(p.FSS / 2) == p.FDS
    assert pytest.approx((jack.FDJ1, 2 * jack.FDJ1)) == (p.FDJ, p.FSJ)


def test_hot_oil_thins_and_leaks():
    actuator = default_actuator()
    cold = coefficients(actuator, Faults(), Effects())
    hot = coefficients(actuator, Faults(), Effects(oil_temperature=100.0, gain_change=0.1))
    thin = 3.5 / 14.5
    assert pytest.approx(cold.CJ * thin) == hot.CJ
    assert pytest.approx(1.0 / thin) == hot.CLK / cold.CLK
    assert pytest.approx(actuator.servovalve.CS * (thin - 1.0)) == hot.DAMPING - cold.DAMPING
    assert pytest.approx(1.1 * cold.GM) == hot.GM
    assert (hot.PSR, hot.GP, hot.FORCE) == (cold.PSR, cold.GP, cold.FORCE)


def test_supply_minus_return_is_what_saturates():
    p = coefficients(
        default_actuator(), Faults(), Effects(supply_pressure=20.1e6, return_pressure=0.7e6)
    )
    assert pytest.approx(19.4e6) == p.PSR
