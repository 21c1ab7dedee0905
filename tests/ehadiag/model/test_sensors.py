"""Sensors and load of the model: against the simulator, and one kernel against another.

Smooth curves of torque motor and spool sensor, and friction by direction, beside the plant's.
"""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import (
    CURRENT,
    LSB,
    MODELS,
    batch_of,
    residuals_of,
    rms,
    severities,
    simulated,
    unknowns_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from ehadiag.model.batch import Anchor
from ehadiag.model.sensors import (
    cubic_through_ends,
    cubic_through_stages,
    filter_output,
    filter_step,
)
from ehadiag_sim.conditions import Effects, UnmodelledEffects
from firmware_iface.stored_test import resolve_test

BOTH = pytest.mark.parametrize("kind", list(MODELS))
SENSING = [
    pytest.param({"sampling_lead": 0.13e-3}, {"early": 0.13e-3}, id="lead"),
    pytest.param({"filter_time": 0.12e-3}, {"filter_time": 0.12e-3}, id="filter"),
    pytest.param(
        {"filter_time": 0.05e-3, "sampling_lead": 0.08e-3},
        {"filter_time": 0.05e-3, "early": 0.08e-3},
        id="filter and lead",
    ),
]


@given(
    cubic=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    before=st.floats(-1.0, 1.0),
    lag=st.floats(1e-6, 10.0),
    share=st.floats(1e-6, 1.0),
)
def test_the_filter_follows_a_cubic_exactly(cubic, before, lag, share):
    span = 0.7
    found = filter_output(filter_step(lag, span, share * span), before, cubic)

    def shown(ago):
        # The output is the past, weighed by exp(-ago / lag) / lag.
        return np.polyval(cubic[::-1], share - ago * lag / span) * np.exp(-ago)

    long = share * span / lag
    past = sum(
        quad(shown, a, b, epsabs=1e-12)[0]
        for a, b in ((0.0, min(long, 3.0)), (min(long, 3.0), min(long, 40.0)))
    )
    assert found == pytest.approx(before * np.exp(-long) + past, abs=1e-6)


def test_cubics_go_through_what_they_are_made_of():
    u = np.linspace(0.0, 1.0, 5)
    ends = np.polyval(cubic_through_ends(1.0, -2.0, 3.0, 0.5)[::-1], u)
    assert ends[[0, -1]] == pytest.approx([1.0, -2.0])
    slopes = np.polyval(np.polyder(cubic_through_ends(1.0, -2.0, 3.0, 0.5)[::-1]), u)
    assert slopes[[0, -1]] == pytest.approx([3.0, 0.5])
    stages = (1.0, 2.0, -1.0, 0.5)
    places = [0.0, (4.0 - 6.0**0.5) / 10.0, (4.0 + 6.0**0.5) / 10.0, 1.0]
    assert np.polyval(cubic_through_stages(*stages)[::-1], places) == pytest.approx(stages)


@BOTH
@pytest.mark.parametrize(("values", "sensors"), SENSING)
def test_filter_and_instant_are_the_simulators(kind, values, sensors):
    measured = simulated(**sensors)
    here = residuals_of(kind, {**severities(), **values}, batch_of(measured))
    without = residuals_of(kind, severities(), batch_of(measured))
    assert (rms(here) < 0.1).all()
    assert np.quantile(np.abs(here), 0.99) < 0.25
    assert (rms(without)[:2] > 2.0).all()  # they show


@BOTH
def test_gains_and_offsets_are_what_the_converters_do(kind):
    measured = simulated()
    gains, offsets = np.array([0.004, -0.003, 0.005]), np.array([2e-6, 1e5, -3e-4])
    shown = measured * (1.0 + gains[:, None]) + offsets[:, None]
    names = ("spool", "pressure", "position")
    values = {f"{name}_gain": gain for name, gain in zip(names, gains, strict=True)}
    values |= {f"{name}_offset": offset for name, offset in zip(names, offsets, strict=True)}
    plain = residuals_of(kind, severities(), batch_of(measured))
    here = residuals_of(kind, {**severities(), **values}, batch_of(shown))
    # With more unknowns the lanes take the jack's steps by other candidates.
    np.testing.assert_allclose(here, plain, atol=1e-2 if kind == "alone" else 5e-2)
    assert (rms(here - plain) < 1e-2).all()


@BOTH
@pytest.mark.parametrize("spring", [0.0, 3e4])
def test_loads_are_the_simulators(kind, spring):
    measured = simulated(effects=Effects(load=80.0, load_spring=spring))
    here = residuals_of(
        kind, {**severities(), "load": 80.0, "load_spring": spring}, batch_of(measured)
    )
    without = residuals_of(kind, severities(), batch_of(measured))
    assert (rms(here) < 0.25).all()
    assert rms(without)[1] > 1.0


@BOTH
def test_the_jack_shows_its_fast_part_where_it_is_followed(kind):
    """Moving the model by a share of the innovation is a high-pass filter on the residual."""
    drift = 3e-4 * np.sin(np.linspace(0.0, 5.0, len(CURRENT)))
    measured = simulated()
    measured[2] += drift
    free = residuals_of(kind, severities(), batch_of(measured))
    followed_jack = residuals_of(
        kind, severities(), batch_of(measured, anchor=Anchor(0.0, np.inf, np.inf, 0.05))
    )
    taken, expected = 0.0, []
    for value in free[2]:
        expected.append(value - taken)
        taken += 0.05 * expected[-1]
    np.testing.assert_allclose(followed_jack[2], expected, atol=0.05)
    np.testing.assert_allclose(followed_jack[:2], free[:2], atol=1e-6)


@BOTH
def test_a_dead_or_wrong_jack_sensor_shows(kind):
    anchor = Anchor(0.0, np.inf, np.inf, 0.01)
    measured = simulated()
    right = rms(residuals_of(kind, severities(), batch_of(measured, anchor=anchor)))
    for share in (0.0, 0.8):
        wrong = measured * np.array([[1.0], [1.0], [share]])
        found = rms(residuals_of(kind, severities(), batch_of(wrong, anchor=anchor)))
        assert found[2] > 5.0 > 50.0 * right[2]


@BOTH
def test_without_the_jack_all_is_as_it_was(kind):
    measured = simulated()
    with_jack = residuals_of(kind, severities(), batch_of(measured))
    without = residuals_of(kind, severities(), batch_of(measured, rows=2))
    np.testing.assert_array_equal(without, with_jack[:2])


@BOTH
def test_a_missing_jack_sample_counts_nothing(kind):
    measured = simulated()
    measured[2, 100:200] = np.nan
    found = residuals_of(
        kind, severities(), batch_of(measured, anchor=Anchor(0.0, np.inf, np.inf, 0.01))
    )
    assert np.isfinite(found).all()
    assert not found[2, 100:200].any()


EFFECTS = st.fixed_dictionaries(
    {
        "Kintas": st.floats(0.0, 1.0),
        "FSS": st.floats(0.0, 1.0),
        "FDJ": st.floats(0.0, 1.0),
        "spool_gain": st.floats(-0.005, 0.005),
        "pressure_gain": st.floats(-0.005, 0.005),
        "position_gain": st.floats(-0.005, 0.005),
        "filter_time": st.one_of(st.just(0.0), st.floats(1e-6, 2e-4)),
        "sampling_lead": st.one_of(st.just(0.0), st.floats(0.0, 2e-4)),
        "load": st.floats(-200.0, 200.0),
        "load_spring": st.floats(0.0, 2e4),
    }
)
SLOW_CURRENT = 3e-3 * np.sin(np.arange(300) * 0.045)


@settings(max_examples=40, deadline=None)
@given(values=EFFECTS, neighbour=EFFECTS)
def test_blocks_and_one_alone_agree(values, neighbour):
    """Spool to rounding; pressure and jack within what both differ by without these effects."""
    batch = batch_of(np.zeros((3, len(SLOW_CURRENT))), SLOW_CURRENT)
    unknowns = unknowns_of(values)
    points = np.array([[one[name] for name in values] for one in (values, neighbour)])
    one_by_one = MODELS["alone"](batch, unknowns).residuals(points)[0]
    model = MODELS["block"](batch, unknowns)
    together = model.residuals(points)[0]
    gaps = np.abs(together - one_by_one)
    assert np.quantile(gaps[:, 0], 0.99) < 0.1
    assert np.quantile(gaps[:, 1], 0.98) < 0.5
    assert gaps[:, 2].max() < 1.0
    # Beside a neighbour with a filter the same sums are compiled anew: the last digits may differ.
    for i in range(2):
        alone = model.residuals(points[i : i + 1])[0][0]
        np.testing.assert_allclose(alone, together[i], rtol=1e-9, atol=1e-9)


def test_units_of_the_weights_are_steps_of_the_converters():
    assert (batch_of(np.zeros((3, len(CURRENT)))).weight[:, 0] * LSB == 1.0).all()


FAULTS = (0.3, 0.2, 0.4)
HYSTERESIS = {"hysteresis": 0.03}


@BOTH
@pytest.mark.parametrize(
    ("effects", "values"),
    [
        (Effects(unmodelled=UnmodelledEffects(torque_cubic=-0.05)), {"torque_odd": -0.05}),
        (Effects(unmodelled=UnmodelledEffects(friction_asymmetry=0.05)), {"friction_way": 0.05}),
        (Effects(unmodelled=UnmodelledEffects(land_shift=2e-6)), {"land_shift": 2e-6}),
        (Effects(unmodelled=UnmodelledEffects(land_asymmetry=0.03)), {"land_even": 0.03}),
    ],
    ids=["torque", "friction", "shift", "asymmetry"],
)
def test_an_effect_is_the_simulators(kind, effects, values):
    measured = simulated(FAULTS, effects)
    here = residuals_of(kind, {**severities(FAULTS), **values}, batch_of(measured))
    without = residuals_of(kind, severities(FAULTS), batch_of(measured))
    # Where full current turns, a jack that turns within the tick makes one sample wrong.
    assert (rms(np.clip(here, -3.0, 3.0)) < [0.05, 0.3, 0.05]).all()
    assert np.mean(np.abs(without[1])) > 10.0 * np.mean(np.abs(here[1]))


@BOTH
def test_a_lag_of_the_driver_delays_the_spool(kind):
    """Held over each tick is the mean of what flows, so that little of the lag is left."""
    current = resolve_test("open").command()[:1500]
    measured = simulated(
        FAULTS, Effects(unmodelled=UnmodelledEffects(driver_lag=3e-4)), current=current
    )
    batch = batch_of(measured, current)
    here = residuals_of(kind, {**severities(FAULTS), "driver_lag": 3e-4}, batch)
    without = residuals_of(kind, severities(FAULTS), batch)
    assert (rms(without) > 4.0 * rms(here))[[0, 2]].all()
    assert np.mean(np.abs(here[1])) < 0.1


@BOTH
def test_lands_that_overlap_pass_less_near_the_middle(kind):
    values = {**severities(FAULTS), "land_lap": 1e-6}
    batch = batch_of(simulated(FAULTS))
    overlap = residuals_of(kind, values, batch)[1]
    assert rms(overlap[None])[0] > 0.7
    # A small overlap is a smaller pressure gain in the middle, and less flow at any opening.
    same = residuals_of(kind, {**values, "land_lap": 0.0}, batch)[1]
    assert rms(same[None])[0] < 0.3


@BOTH
def test_a_bent_pressure_sensor_reads_a_cubic(kind):
    supply = 20e6
    straight = simulated(FAULTS)
    share = straight[1] / supply
    bent = straight.copy()
    bent[1] *= 0.99 + 0.004 * share - 0.01 * share**2
    gains = {"pressure_gain": -0.01, "pressure_bend": 0.004, "pressure_bow": -0.01}
    here, plain = (
        residuals_of(kind, {**severities(FAULTS), **values}, batch_of(bent))[1]
        for values in (gains, {})
    )
    assert np.mean(np.abs(here)) < 0.02 * np.mean(np.abs(plain))


@BOTH
def test_wide_plays_may_count_less(kind):
    effects = Effects(hysteresis=0.03, plays=8, unmodelled=UnmodelledEffects(play_skew=2.0))
    batch = batch_of(simulated(FAULTS, effects))
    values = {**severities(FAULTS), **HYSTERESIS}
    plain, skewed = (
        residuals_of(kind, {**values, "hysteresis_skew": skew}, batch, plays=8)
        for skew in (0.0, 2.0)
    )
    assert rms(skewed)[0] < 0.05
    assert rms(plain)[0] > 1.0


@BOTH
def test_a_bent_spool_sensor_reads_a_cubic(kind):
    stop = 0.381e-3
    straight = simulated(FAULTS)
    share = straight[0] / stop
    bent = straight.copy()
    bent[0] *= 1.01 + 0.004 * share - 0.01 * share**2
    values = {**severities(FAULTS), "spool_gain": 0.01, "spool_bend": 0.004, "spool_bow": -0.01}
    here = residuals_of(kind, values, batch_of(bent))
    assert rms(here)[0] < 0.05
