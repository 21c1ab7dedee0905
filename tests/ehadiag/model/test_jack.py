"""The jack's one algorithm against scipy's stiff solver, piece by piece.

Jacks of many candidates along a measured path of the spool: against one alone. Friction that
falls with the velocity: against the simulator, and one kernel against another. The filter before
the converter: against the same jack cut into short parts.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from effect_cases import MODELS, batch_of, residuals_of, rms, severities, simulated, unknowns_of
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ehadiag import default_actuator
from ehadiag.compile.vector import LANES, VECTOR_WIDTH
from ehadiag.model.laws import exp_minus, jack_law, plant_of, stage_pressure, stage_resistance
from ehadiag.model.registry import FAULTS, Unknowns
from ehadiag.model.sensors import PathPiece, sensor_law
from ehadiag.model.simd_jack import driven_jack_costs
from ehadiag.model.simd_jack_pieces import (
    JACK_STEPS,
    limited_pressure,
    linear_events,
    orifice_events,
    sensed_linear_events,
    sensed_orifice_events,
)
from ehadiag.model.simd_layout import (
    COEFFICIENTS,
    LANE_STATE_ROWS,
    ROWS,
    keep_jack_law,
    keep_sensor_law,
)
from ehadiag_sim.conditions import Effects
from ehadiag_tools.simulator.units import damaged_unit
from firmware_iface.recording import CHANNELS, Environment

SPAN = 1e-3
PLACE = 0.5 * CHANNELS.position.lsb
"""Largest error of the place, m: each step goes by its mean velocity, and no residual has it."""
CONSTANTS = damaged_unit((0.0, 0.0, 0.4))
LAW = jack_law(CONSTANTS)


def place_of(piece, q):
    r = 1.0 - q
    return (
        piece.x0
        + q * q * (3.0 - 2.0 * q) * (piece.x1 - piece.x0)
        + q * r * (r * piece.rise0 - q * piece.rise1)
    )


def exactly(piece, state, begin=0.0, stop=1.0):
    """Stops and starts located by the solver's own events; place, velocity, direction."""
    c, law = CONSTANTS, LAW
    place, velocity, d = state[:3]
    now, end = begin * piece.span, stop * piece.span

    def force(t, v):
        x = place_of(piece, t / piece.span)
        e = stage_resistance(law, x)
        return c.AJ * (law.flow * x - v) / e - c.CJ * v - c.FR

    for _ in range(200):
        if d == 0.0:
            times = np.linspace(now, end, 4001)
            pushes = np.array([force(t, 0.0) for t in times])
            over = np.flatnonzero(np.abs(pushes) > law.static)
            if not over.size:
                return place, 0.0, 0.0
            now, d, velocity = times[over[0]], np.sign(pushes[over[0]]), 0.0

        def rates(t, y, d=d):
            return [y[1], (force(t, y[1]) - d * law.friction) / c.MJ]

        def stops(t, y, d=d, begun=now):
            return y[1] * d if t > begun + 1e-9 else 1.0

        stops.terminal, stops.direction = True, -1
        done = solve_ivp(
            rates, (now, end), [place, velocity], "Radau", rtol=1e-9, atol=[1e-13, 1e-11],
            events=stops, max_step=piece.span / 50.0,
        )  # fmt: skip
        place, velocity = done.y[:, -1]
        now = done.t[-1]
        if done.status != 1:
            return place, velocity, d
        velocity, d = 0.0, 0.0
    raise AssertionError("it never ends")


class Jack(NamedTuple):
    """State between two pieces, SI."""

    place: float
    velocity: float
    direction: float
    fresh: float
    pressure: float = 0.0
    lagged: float = 0.0
    seen: float = 0.0


JACK_ROWS = (
    ROWS.jack, ROWS.jack_velocity, ROWS.jack_direction, ROWS.fresh,
    ROWS.pressure, ROWS.pressure_lagged, ROWS.pressure_sampled,
)  # fmt: skip


def over(piece, begin, stop, state, law=LAW, *, events=linear_events, sensor=None, due=-1.0):
    """The jack there, the same in all lanes; due: instant of sampling, s."""
    numbers, coefficients = np.zeros(LANE_STATE_ROWS * LANES), np.zeros(COEFFICIENTS.end * LANES)
    for i in range(VECTOR_WIDTH):
        keep_jack_law(coefficients, i, law)
        keep_sensor_law(coefficients, i, sensor or sensor_law(CONSTANTS))
    for row, value in zip(JACK_ROWS, state, strict=True):
        numbers[row * LANES : row * LANES + VECTOR_WIDTH] = value
    lanes = np.ones(VECTOR_WIDTH)
    with np.errstate(all="ignore"):  # as in the kernel, where both sides of a choice are made
        events(
            0, lanes, PathPiece(*(lanes * item for item in piece)), lanes * due, begin, stop,
            numbers, coefficients,
        )  # fmt: skip
    return Jack(*(float(numbers[row * LANES]) for row in JACK_ROWS))


def piece_through(x0, x1, bend=0.0):
    straight = x1 - x0
    return PathPiece(SPAN, x0, x1, straight + bend, straight - bend)


MOVING = [
    (piece_through(30e-6, 31e-6), Jack(0.0, 0.012, 1.0, 0.0)),
    (piece_through(30e-6, 40e-6, 3e-6), Jack(0.0, 0.01, 1.0, 0.0)),
    (piece_through(-200e-6, -150e-6), Jack(0.0, -0.09, -1.0, 0.0)),
    (piece_through(300e-6, 320e-6), Jack(0.0, 0.0, 0.0, 0.0)),
    (piece_through(40e-6, -60e-6), Jack(0.0, 0.02, 1.0, 0.0)),
    (piece_through(5e-6, -5e-6, 4e-6), Jack(0.0, 0.001, 1.0, 0.0)),
    (piece_through(0.0, 60e-6), Jack(0.0, 0.0, 0.0, 0.0)),
    (piece_through(60e-6, 0.0), Jack(0.0, 0.02, 1.0, 0.0)),
]


@pytest.mark.parametrize(("piece", "state"), MOVING)
def test_a_piece_ends_where_the_stiff_solver_ends(piece, state):
    """Sliding, starting, stopping, turning round."""
    place, velocity, d = exactly(piece, state)
    found = over(piece, 0.0, 1.0, state)
    assert found[2] == d
    fastest = max(abs(state.velocity), abs(velocity), 1e-3)
    assert found[1] == pytest.approx(velocity, abs=5e-3 * fastest)
    assert found[0] == pytest.approx(place, abs=PLACE)


@given(
    x0=st.floats(-100e-6, 100e-6),
    travel=st.floats(-20e-6, 20e-6),
    share=st.floats(-1.2, 1.2),
    begin=st.floats(0.0, 0.9),
    length=st.floats(0.05, 1.0),
)
@settings(max_examples=40, deadline=None)
def test_so_it_does_over_any_part_of_a_piece(x0, travel, share, begin, length):
    """The velocity before is any share of the one that would be steady."""
    piece, stop = piece_through(x0, x0 + travel), min(1.0, begin + length)
    velocity = share * LAW.flow * place_of(piece, begin)
    assume(velocity == 0.0 or abs(velocity) > JACK_STEPS.least_velocity)  # less counts as none
    state = Jack(0.0, velocity, float(np.sign(velocity)), 1.0 if velocity else 0.0)
    place, after, d = exactly(piece, state, begin, stop)
    found = over(piece, begin, stop, state)
    # A jack that hardly moves may come to rest a little sooner.
    fastest = max(abs(velocity), abs(after), LAW.flow * (abs(x0) + abs(travel)), 2e-2)
    assert found[1] == pytest.approx(after, abs=1e-2 * fastest)
    assert found[0] == pytest.approx(place, abs=PLACE)
    if abs(after) > 1e-2 * fastest:
        assert found[2] == d


@pytest.mark.parametrize("parts", [2, 4, 16, 64])
def test_pieces_cut_finer_converge(parts):
    """Of a sliding jack: what is left after a cut is less than a thousandth of a velocity."""
    piece, state = MOVING[1]
    once = over(piece, 0.0, 1.0, state)
    cut = state
    for k in range(parts):
        cut = over(piece, k / parts, (k + 1) / parts, cut)
    _, velocity, _ = exactly(piece, state)
    assert cut.velocity == pytest.approx(velocity, rel=1e-4)
    assert cut.velocity == pytest.approx(once[1], rel=1e-3)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_jack_breaks_away_when_the_force_is_there(way):
    """On a straight path, where the first guess of the instant is the root, from either side."""
    breaks_at = (
        LAW.static
        / (CONSTANTS.AJ * CONSTANTS.GP)
        * (1.0 + CONSTANTS.GP * CONSTANTS.CLK / CONSTANTS.GQ)
    )
    for share in np.linspace(0.03, 0.97, 48):
        piece = piece_through(0.0, way * breaks_at / share)
        rest = Jack(0.0, 0.0, 0.0, 0.0)
        early = over(piece, 0.0, share - 1e-4, rest)
        assert early.direction == 0.0
        later = over(piece, 0.0, share + 1e-3, rest)
        assert later.direction == way
        assert later.velocity * way > 0.0


def test_a_jack_against_its_stop_stays_and_comes_back():
    at_stop = Jack(LAW.stroke, 0.0, 0.0, 0.0)
    pushed = over(piece_through(200e-6, 220e-6), 0.0, 1.0, at_stop)
    assert pushed == Jack(LAW.stroke, 0.0, 0.0, 0.0)
    back = over(piece_through(-200e-6, -220e-6), 0.0, 1.0, at_stop)
    assert back.place < LAW.stroke
    assert (back.velocity < 0.0, back.direction) == (True, -1.0)
    striking = Jack(LAW.stroke - 1e-9, 0.09, 1.0, 0.0)
    struck = over(piece_through(250e-6, 250e-6), 0.0, 1.0, striking)
    assert (struck.place, struck.velocity, struck.direction) == (LAW.stroke, 0.0, 0.0)


def test_friction_holds_a_resting_jack():
    """Up to its static friction: over the middle nothing moves, and nothing is kept in mind."""
    rest = Jack(1e-3, 0.0, 0.0, 1.0)
    small = 0.9 * LAW.static / (CONSTANTS.AJ * CONSTANTS.GP)
    found = over(piece_through(-small, small), 0.0, 1.0, rest)
    assert found == Jack(1e-3, 0.0, 0.0, 0.0)


TICKS, TICK, BEFORE, NOISE = 400, 1e-3, 2e-7, 3e4


def driven_pressures(law, places, rates):
    """Of a jack on the path, tick by tick."""
    state, before, out = Jack(0.0, 0.0, 0.0, 0.0), BEFORE, []
    for place, rate in zip(places, rates, strict=True):
        piece = PathPiece(TICK, before, place, rate * TICK, rate * TICK)
        state = over(piece, 0.0, 1.0, state, law)
        out.append(float(limited_pressure(law, stage_pressure(law, place, state.velocity))))
        before = place
    return np.array(out)


def test_costs_are_those_of_a_jack_alone():
    rng = np.random.default_rng(3)
    base = damaged_unit((0.0, 0.0, 0.0), environment=Environment())
    points = rng.uniform(0.0, 1.0, (19, len(FAULTS)))
    candidates = Unknowns(FAULTS, (base,), {}).candidates(points)[:, 0]
    # To and fro past the closed orifice: jacks start, creep and stop.
    place = 8e-6 * np.sin(np.arange(1, TICKS + 1) / 40.0) + 2e-7 * rng.standard_normal(TICKS)
    rate = np.diff(place, prepend=BEFORE) / TICK
    nodes = np.column_stack([np.full(TICKS, TICK), place, rate, rate, np.zeros(TICKS)])
    measured = 1e5 * rng.standard_normal(TICKS)
    measured[::17] = np.nan
    found = driven_jack_costs(candidates, nodes, BEFORE, measured, NOISE, 25.0)
    for row, cost in zip(candidates, found, strict=True):
        alone = driven_jack_costs(row[None, :], nodes, BEFORE, measured, NOISE, 25.0)
        assert cost == pytest.approx(alone[0], rel=1e-9)
    pressure = driven_pressures(jack_law(plant_of(candidates[7])), place, rate)
    residuals = (measured - pressure) / NOISE
    assert found[7] == pytest.approx(np.minimum(residuals**2, 25.0)[~np.isnan(residuals)].sum())


PARTS = 400
"""Parts of a piece, 1, over which a pressure is a line."""


def through_parts(piece, state, law, events, lag, due):
    """Pressure behind the filter at the end, and at `due`, by short parts, Pa."""
    lagged, seen, span = state.lagged, state.seen, piece.span / PARTS

    def pressure(jack, q):
        if law.oil > 0.0:
            return jack.pressure
        return float(limited_pressure(law, stage_pressure(law, place_of(piece, q), jack.velocity)))

    before = pressure(state, 0.0)
    for k in range(PARTS):
        state = over(piece, k / PARTS, (k + 1) / PARTS, state, law, events=events)
        after = pressure(state, (k + 1) / PARTS)
        if k * span < due <= (k + 1) * span:
            share = (due - k * span) / span
            mean = before + 0.5 * share * (after - before)
            seen = mean + (lagged - mean) * np.exp(-share * span / lag)
        mean = 0.5 * (before + after)
        lagged = mean + (lagged - mean) * np.exp(-span / lag)
        before = after
    return lagged, seen


@pytest.mark.parametrize("stribeck", [0.0, 5e-3])
@pytest.mark.parametrize("kind", ["linear", "orifice"])
@pytest.mark.parametrize("case", range(len(MOVING)))
def test_the_pressure_behind_its_filter_is_that_of_short_parts(case, kind, stribeck):
    """Through starts, stops and turns within the piece, sampled before its end."""
    values = {"FDJ": 0.4, "jack_stribeck": stribeck}
    space = unknowns_of(values, ORIFICE if kind == "orifice" else LINEAR)
    c = plant_of(space.candidates(np.array([list(values.values())]))[0, 0])
    law, lag, due = jack_law(c), 2e-4, 0.7 * SPAN
    piece, state = MOVING[case]
    rest = float(limited_pressure(law, stage_pressure(law, piece.x0, state.velocity)))
    # Velocities are not those of the path: as after a start.
    state = state._replace(fresh=abs(state.direction), pressure=rest, lagged=0.5 * rest)
    plain, sensed = (
        (linear_events, sensed_linear_events) if kind == "linear"
        else (orifice_events, sensed_orifice_events)
    )  # fmt: skip
    sensor = sensor_law(c)._replace(lag=lag, lead=SPAN - due)
    found = over(piece, 0.0, 1.0, state, law, events=sensed, sensor=sensor, due=due)
    # With Stribeck's friction only the kernel that senses follows it, behind a line.
    parts = sensed if stribeck and kind == "linear" else plain
    lagged, seen = through_parts(piece, state, law, parts, lag, due)
    tolerance = 5.0 * CHANNELS.pressure.lsb
    assert found.lagged == pytest.approx(lagged, abs=tolerance)
    assert found.seen == pytest.approx(seen, abs=tolerance)


LINEAR = default_actuator()
ORIFICE = msgspec.structs.replace(
    LINEAR, second_stage=msgspec.structs.replace(LINEAR.second_stage, kind="orifice")
)
STAGES = pytest.mark.parametrize("actuator", [LINEAR, ORIFICE], ids=["linear", "orifice"])


@given(z=st.floats(0.0, 1e6))
def test_fading_is_exponential(z):
    assert exp_minus(z) == pytest.approx(np.exp(-z), abs=1e-9)


@STAGES
@pytest.mark.parametrize("velocity", [1e-3, 5e-3, 50e-3])
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.7)])
def test_the_jacks_friction_is_the_simulators(actuator, velocity, faults):
    measured = simulated(faults, Effects(jack_stribeck=velocity), actuator=actuator)
    values = {**severities(faults), "jack_stribeck": velocity}
    for kind in MODELS:
        here = residuals_of(kind, values, batch_of(measured), actuator)
        without = residuals_of(kind, severities(faults), batch_of(measured), actuator)
        # Where full current turns, a jack that turns within the tick makes one sample wrong.
        assert (rms(np.clip(here, -3.0, 3.0)) < [0.05, 0.4, 0.05]).all(), kind
        assert np.quantile(np.abs(here[1]), 0.9) < 0.5, kind
        assert np.mean(np.abs(without[1])) > 4.0 * np.mean(np.abs(here[1])), kind


@pytest.mark.parametrize("backlash", [0.0, 3e-6])
@pytest.mark.parametrize("velocity", [5e-3, 20e-3, 50e-3])
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.7)])
def test_the_spools_friction_is_the_simulators(velocity, faults, backlash):
    measured = simulated(faults, Effects(spool_stribeck=velocity, backlash=backlash))
    values = {**severities(faults), "spool_stribeck": velocity, "backlash": backlash}
    for kind in MODELS:
        here = residuals_of(kind, values, batch_of(measured))
        without = residuals_of(kind, {**values, "spool_stribeck": 0.0}, batch_of(measured))
        # At 5 mm/s the velocity of a worn spool runs away: what a step does lasts.
        assert (rms(np.clip(here, -3.0, 3.0)) < [0.15, 0.3, 0.05]).all(), kind
        assert rms(without)[0] > 1.0, kind


VALUES = st.fixed_dictionaries(
    {
        "Kintas": st.floats(0.0, 1.0),
        "FSS": st.floats(0.0, 1.0),
        "FDJ": st.floats(0.0, 1.0),
        # Below, the velocity of a worn spool runs away, and which way it goes hangs on a micron.
        "spool_stribeck": st.one_of(st.just(0.0), st.floats(20e-3, 0.1)),
        "jack_stribeck": st.one_of(st.just(0.0), st.floats(1e-3, 0.1)),
        "filter_time": st.one_of(st.just(0.0), st.floats(1e-6, 2e-4)),
    }
)
SLOW_CURRENT = 3e-3 * np.sin(np.arange(300) * 0.045)


@STAGES
@settings(max_examples=25, deadline=None)
@given(values=VALUES, neighbour=VALUES)
def test_blocks_and_one_alone_agree(actuator, values, neighbour):
    batch = batch_of(np.zeros((3, len(SLOW_CURRENT))), SLOW_CURRENT)
    points = np.array([[one[name] for name in values] for one in (values, neighbour)])
    one, other = (
        model(batch, unknowns_of(values, actuator)).residuals(points)[0]
        for model in MODELS.values()
    )
    gaps = np.abs(one - other)
    assert np.quantile(gaps[:, 1], 0.97) < 0.5
    assert gaps[:, 2].max() < 1.0
