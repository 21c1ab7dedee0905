"""A valve whose filter takes pressure too, and whose oil yields: against the simulator."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from effect_cases import MODELS, batch_of, residuals_of, rms, severities, simulated
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import optimize

from ehadiag import Monitor, Tick, default_actuator
from ehadiag.compile.elementary import exponential, logarithm
from ehadiag.model.laws import (
    SPOOL_DYNAMIC_FRICTION_SHARE,
    bridge_bend,
    bridge_load,
    bridge_speed,
    bridge_stall,
    jack_law,
    spool_law,
)
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import parameter
from ehadiag.model.second_stage import oil_at

BOTH = pytest.mark.parametrize("kind", list(MODELS))
WORN = (0.5, 0.2, 0.4)


def with_exponent(exponent):
    actuator = default_actuator()
    valve = msgspec.structs.replace(actuator.servovalve, clogging_exponent=exponent)
    return msgspec.structs.replace(actuator, servovalve=valve)


def with_chambers(**stage):
    actuator = default_actuator()
    stage = msgspec.structs.replace(
        actuator.second_stage,
        kind="orifice",
        by_position=True,
        volume_of_one_chamber=0.9e-4,
        **stage,
    )
    return msgspec.structs.replace(actuator, second_stage=stage)


@given(severity=st.floats(0.0, 1.0))
def test_exponent_zero_is_the_papers_law_to_the_last_bit(severity):
    c = plant_constants(default_actuator())
    made = parameter("Kintas").changes(c, severity)
    assert made["GPF"] == c.GPF
    assert made["GQF"] == c.GQF * (1.0 - 0.8 * severity)
    assert c.GPF * exponential(c.CLE * logarithm(1.0 - 0.8 * severity)) == c.GPF


@BOTH
@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_both_kernels_have_the_simulators_law_of_clogging(kind, exponent):
    actuator = with_exponent(exponent)
    measured = simulated(WORN, actuator=actuator)
    here = residuals_of(kind, severities(WORN), batch_of(measured), actuator)
    assert (rms(here) < [0.12, 0.06, 0.02]).all(), "a line for the bridge's curve leaves 0.4"
    papers = residuals_of(kind, severities(WORN), batch_of(measured))
    assert rms(papers)[0] > 5.0, "the exponent shows"


def test_the_monitor_has_it_too():
    actuator = with_exponent(2.0)
    current = np.concatenate([np.linspace(0.0, 6e-3, 300), np.full(100, -6e-3)])
    measured = simulated(WORN, actuator=actuator, current=current)
    worst = {}
    for name, unit in (("own", actuator), ("paper's", default_actuator())):
        monitor = Monitor(unit, WORN)
        residuals = [
            float(monitor.push(Tick(i, i, x, p, y)).residual[0])
            for i, x, p, y in zip(current, *measured, strict=True)
        ]
        worst[name] = np.nanmax(np.abs(residuals))
    assert worst["own"] < 2.0
    assert worst["paper's"] > 20.0


@BOTH
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.4)])
def test_chambers_follow_the_jack(kind, faults):
    actuator = with_chambers()
    measured = simulated(faults, actuator=actuator)
    here = residuals_of(kind, severities(faults), batch_of(measured), actuator)
    assert (rms(here) < [0.05, 0.3, 0.05]).all()
    fixed = msgspec.structs.replace(actuator.second_stage, by_position=False)
    other = msgspec.structs.replace(actuator, second_stage=fixed)
    assert rms(residuals_of(kind, severities(faults), batch_of(measured), other))[1] > 3.0


@given(place=st.floats(-0.05, 0.05))
def test_oil_is_least_stiff_in_the_middle(place):
    j = jack_law(plant_constants(with_chambers()))
    share = 1.6e-3 * place / 0.9e-4
    assert oil_at(j, place) >= j.oil
    assert oil_at(j, place) == pytest.approx(
        0.5 * j.oil * (1.0 / (1.0 + share) + 1.0 / (1.0 - share))
    )


def bridge_of(k, x, load):
    """Speed of a spool (PHY-43) by a root finder: over that at no load with x = 1."""

    def misfit(z):
        high, q, supply = z
        low = high - load / supply
        near, far = (1.0 - x) * np.sqrt(high), (1.0 + x) * np.sqrt(low)
        part = q / np.sqrt(2.0 * supply)
        return [
            np.sqrt(1.0 - high) - near - part,
            np.sqrt(1.0 - low) - far + part,
            supply * (k**2 + (1.0 - k**2) * 0.5 * (near + far) ** 2) - 1.0,
        ]

    found = optimize.root(misfit, [0.5 + 0.5 * load, x - load, 1.0])
    assert found.success
    return found.x[1]


@pytest.mark.parametrize("k", [1.0, 0.6, 0.3])
@pytest.mark.parametrize("load", [0.02, 0.1, 0.3])
def test_the_bridge_is_that_of_its_orifices(k, load):
    for x in (0.8, 1.0):
        assert bridge_speed(k * k, load, 0.0, x) == pytest.approx(bridge_of(k, x, load), abs=1e-8)
    assert bridge_of(k, bridge_stall(k * k, load), load) == pytest.approx(0.0, abs=1e-8)


@given(
    k=st.floats(0.2, 1.0),
    share=st.floats(0.0, 1.0),
    viscous=st.floats(0.0, 2.0),
    x=st.floats(0.05, 1.1),
)
@example(k=0.25, share=1.0, viscous=0.0, x=1.0)
def test_a_bridge_balances_up_to_its_stall(k, share, viscous, x):
    """Friction of any size and cold oil; Newton's method had speeds of -12 and +900."""
    part, near, far = k * k, max(1.0 - x, 0.0), 1.0 + x
    load = share * bridge_load(part, near, far, 0.0)[0]
    stall = bridge_stall(part, load)
    there = bridge_load(part, max(1.0 - stall, 0.0), 1.0 + stall, 0.0)[0]
    # Where the nozzle closes the load has a kink, at which the rounds end early.
    assert stall <= x + 1e-7 or abs(there - load) < 1e-6
    speed = bridge_speed(part, load, viscous, x)
    assert 0.0 <= speed <= math.sqrt(2.0) / k
    found = optimize.brentq(
        lambda flow: bridge_load(part, near, far, flow)[0]
        - load
        - viscous * bridge_load(part, near, far, flow)[1],
        0.0, 1.0, xtol=1e-14,
    )  # fmt: skip
    assert speed == pytest.approx(bridge_load(part, near, far, found)[1], abs=1e-8)


def test_the_kernels_agree_on_a_bridge_whose_null_is_off():
    actuator = with_exponent(2.0)
    measured = simulated((0.3, 0.8, 0.4), actuator=actuator)
    values = {**severities((0.3, 0.8, 0.4)), "first_stage_null": 5e-7}
    one, other = (residuals_of(kind, values, batch_of(measured), actuator) for kind in MODELS)
    assert np.sqrt(np.mean((one - other) ** 2, axis=1)).max() < 0.2
    slews = np.gradient(measured[0])
    there = one[0][: len(slews)]
    assert there[slews > 3e-5].mean() > 1.0, "faster that way than the model"


def test_without_friction_the_bridge_is_the_linear_law():
    papers = plant_constants(default_actuator())._replace(FSS=0.0, CS=0.0)
    bridge = plant_constants(with_exponent(2.0))._replace(FSS=0.0, CS=0.0)
    assert bridge.BRG > 0.0
    law = spool_law(bridge)
    assert [bridge_bend(law, 1e-5 * k) for k in range(4)] == pytest.approx([0.0] * 4, abs=1e-15)
    assert law._replace(by_bend=0.0) == pytest.approx(spool_law(papers), rel=1e-9, abs=1e-15)


@given(
    k=st.floats(0.3, 1.0),
    friction=st.floats(0.0, 0.3),
    share=st.floats(0.05, 1.0),
)
def test_the_speed_by_a_bridges_deflection_is_that_of_its_orifices(k, friction, share):
    """The spool's viscous friction is a load, too."""
    c = plant_constants(with_exponent(2.0))
    c = c._replace(GQF=c.GQF * k, GPF=c.GPF * k * k, FSS=friction * 300.0 * k * k)
    t, gap = spool_law(c), c.XFM / c.BRG
    beyond = share * (c.XFM - t.dry)
    velocity = t.force / t.damping * (beyond + bridge_bend(t, beyond))
    load = (SPOOL_DYNAMIC_FRICTION_SHARE * c.FSS + c.CS * velocity) / (t.force * gap)
    expected = c.GQF * gap / c.AS * bridge_of(k, (t.dry + beyond) / gap, load)
    assert velocity == pytest.approx(expected, rel=1e-4, abs=1e-5)


@given(k=st.floats(0.3, 1.0), friction=st.floats(0.0, 0.3), velocity=st.floats(1e-4, 1e-2))
def test_a_spool_that_creeps_to_rest_stays_within_its_static_friction(k, friction, velocity):
    """Else it would break away in every finest step: minutes for one response."""
    c = plant_constants(with_exponent(2.0))
    c = c._replace(GQF=c.GQF * k, GPF=c.GPF * k * k, FSS=friction * 300.0 * k * k, VSS=velocity)
    t = spool_law(c)
    beyond = t.breakaway - t.dry
    assert beyond + bridge_bend(t, beyond) == pytest.approx(t.extra, rel=1e-9, abs=1e-20)
