"""Collocation step of the sliding jack, and its sensors: gain, offset, filter, sampling.

The jack's step is Radau's collocation of order 5 (IIA, three stages; Hairer, Wanner, Solving
Ordinary Differential Equations II, section IV.5). Before its converter a signal passes a first-
order filter and is sampled some time before the end of the tick; over a cubic the filter is
integrated exactly.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ehadiag.compile.jit import inlined
from ehadiag.compile.vector import Mask, Vector, any_lane, maximum, minimum, packed, where
from ehadiag.model.laws import JackLaw, exp_minus, stribeck_friction
from ehadiag.model.plant import PlantConstants

CREEP_ITERATIONS = 3
"""Iterations for the friction of a creeping jack, 1."""


class RadauTable(NamedTuple):
    """Radau's collocation of order 5: places of the stages in a step, and their weights."""

    c1: float
    """Place of the first stage, as a share of the step, 1."""
    c2: float
    """Place of the second stage, 1; the third is at the end."""
    a11: float
    a12: float
    a13: float
    a21: float
    a22: float
    a23: float
    a31: float
    a32: float
    a33: float
    """Weights of the stages, 1."""


def _radau_table() -> RadauTable:
    root = math.sqrt(6.0)
    return RadauTable(
        (4.0 - root) / 10.0, (4.0 + root) / 10.0,
        (88.0 - 7.0 * root) / 360.0, (296.0 - 169.0 * root) / 1800.0, (3.0 * root - 2.0) / 225.0,
        (296.0 + 169.0 * root) / 1800.0, (88.0 + 7.0 * root) / 360.0, -(3.0 * root + 2.0) / 225.0,
        (16.0 - root) / 36.0, (16.0 + root) / 36.0, 1.0 / 9.0,
    )  # fmt: skip


RADAU = _radau_table()


class RadauMinors(NamedTuple):
    """Minors of the table's weights that belong to its third column, 1."""

    c1: float = RADAU.a21 * RADAU.a32 - RADAU.a22 * RADAU.a31
    c2: float = RADAU.a12 * RADAU.a31 - RADAU.a11 * RADAU.a32
    c3: float = RADAU.a11 * RADAU.a22 - RADAU.a12 * RADAU.a21


RADAU_MINORS = RadauMinors()


@packed
def _stage_pressures(
    j: JackLaw, h: Any, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any, g1: Any, g2: Any, g3: Any,
) -> Any:  # fmt: skip
    """Pressures (Pa) at the three stages of a step of `h` seconds of the moving jack.

    load: external and friction force at its start, N; x1, x2, x3: spool at the three stages, m;
    e1, e2, e3: `stage_resistance` there; g1, g2, g3: more force there, N. Numbers or vectors of
    them.
    """
    k = h * j.by_mass
    thrust, drag = k * j.area, k * j.viscosity
    y1, y2, y3 = j.flow * x1, j.flow * x2, j.flow * x3
    f1, f2, f3 = thrust + drag * e1, thrust + drag * e2, thrust + drag * e3
    # The load spring's force grows with the travel.
    pull, more = k * load, 0.5 * h * k * j.spring * velocity
    z1 = (
        y1
        + drag * (RADAU.a11 * y1 + RADAU.a12 * y2 + RADAU.a13 * y3)
        + RADAU.c1 * pull
        + RADAU.c1 * RADAU.c1 * more
        - velocity
    )
    z2 = (
        y2
        + drag * (RADAU.a21 * y1 + RADAU.a22 * y2 + RADAU.a23 * y3)
        + RADAU.c2 * pull
        + RADAU.c2 * RADAU.c2 * more
        - velocity
    )
    z3 = y3 + drag * (RADAU.a31 * y1 + RADAU.a32 * y2 + RADAU.a33 * y3) + pull + more - velocity
    m11, m12, m13 = e1 + RADAU.a11 * f1, RADAU.a12 * f2, RADAU.a13 * f3
    m21, m22, m23 = RADAU.a21 * f1, e2 + RADAU.a22 * f2, RADAU.a23 * f3
    m31, m32, m33 = RADAU.a31 * f1, RADAU.a32 * f2, e3 + RADAU.a33 * f3
    if g1 is not None:
        z1 = z1 + k * (RADAU.a11 * g1 + RADAU.a12 * g2 + RADAU.a13 * g3)
        z2 = z2 + k * (RADAU.a21 * g1 + RADAU.a22 * g2 + RADAU.a23 * g3)
        z3 = z3 + k * (RADAU.a31 * g1 + RADAU.a32 * g2 + RADAU.a33 * g3)
    # Cramer's rule, the unknowns one by one.
    minor = m11 * m22 - m12 * m21
    below = m31 * (m12 * m23 - m13 * m22) - m32 * (m11 * m23 - m13 * m21) + m33 * minor
    first = (
        z1 * (m22 * m33 - m23 * m32) - z2 * (m12 * m33 - m13 * m32) + z3 * (m12 * m23 - m13 * m22)
    )
    second = (
        z2 * (m11 * m33 - m13 * m31) - z1 * (m21 * m33 - m23 * m31) - z3 * (m11 * m23 - m13 * m21)
    )
    third = m31 * (m12 * z2 - z1 * m22) - m32 * (m11 * z2 - z1 * m21) + z3 * minor
    return first / below, second / below, third / below


@packed
def radau_pressures(
    j: JackLaw, h: Any, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any,
) -> Any:  # fmt: skip
    """Pressures (Pa) at the three stages, Stribeck's friction left out: see `radau_velocity`."""
    return _stage_pressures(j, h, load, velocity, x1, x2, x3, e1, e2, e3, None, None, None)


@packed
def radau_creep_pressures(
    j: JackLaw, h: Any, load: Any, d: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any,
) -> Any:  # fmt: skip
    """Pressures (Pa) at the three stages, Stribeck's friction included.

    Arguments as of `radau_velocity`; d: direction of the motion. What the oil resists is far more
    than what friction gains by velocity, so that a few repetitions find it.
    """
    g = d * stribeck_friction(j, velocity * d)
    p1, p2, p3 = _stage_pressures(j, h, load, velocity, x1, x2, x3, e1, e2, e3, g, g, g)
    for _ in range(CREEP_ITERATIONS):
        g1 = d * stribeck_friction(j, maximum((j.flow * x1 - e1 * p1) * d, x1 * 0.0))
        g2 = d * stribeck_friction(j, maximum((j.flow * x2 - e2 * p2) * d, x1 * 0.0))
        g3 = d * stribeck_friction(j, maximum((j.flow * x3 - e3 * p3) * d, x1 * 0.0))
        p1, p2, p3 = _stage_pressures(j, h, load, velocity, x1, x2, x3, e1, e2, e3, g1, g2, g3)
    return p1, p2, p3


@packed
def radau_velocity(
    j: JackLaw, h: Any, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any,
) -> Any:  # fmt: skip
    """Velocity (m/s) of the moving jack after a step of `h` seconds, Stribeck's friction left out.

    load: external and dynamic friction force at its start, N; x1, x2, x3: spool at the three
    stages, m; e1, e2, e3: `stage_resistance` there. Numbers or vectors of them.
    """
    k = h * j.by_mass
    thrust, drag = k * j.area, k * j.viscosity
    f1, f2, f3 = thrust + drag * e1, thrust + drag * e2, thrust + drag * e3
    # Cramer's rule for the third pressure alone; the state comes last, so that steps that follow
    # one another overlap in the processor.
    c1 = f1 * (RADAU_MINORS.c1 * f2 - RADAU.a31 * e2)
    c2 = f2 * (RADAU_MINORS.c2 * f1 - RADAU.a32 * e1)
    c3 = e1 * (e2 + RADAU.a22 * f2) + f1 * (RADAU.a11 * e2 + RADAU_MINORS.c3 * f2)
    t1 = RADAU.a11 * c1 + RADAU.a21 * c2 + RADAU.a31 * c3
    t2 = RADAU.a12 * c1 + RADAU.a22 * c2 + RADAU.a32 * c3
    t3 = RADAU.a13 * c1 + RADAU.a23 * c2 + RADAU.a33 * c3
    share = e3 / (e3 * c3 + f3 * t3)
    driven = c1 * x1 + c2 * x2 + c3 * x3 + drag * (t1 * x1 + t2 * x2 + t3 * x3)
    more = 0.5 * h * k * j.spring
    by_velocity = c1 + c2 + c3
    by_velocity = by_velocity - more * (RADAU.c1 * RADAU.c1 * c1 + RADAU.c2 * RADAU.c2 * c2 + c3)
    by_load = share * k * (RADAU.c1 * c1 + RADAU.c2 * c2 + c3)
    return j.flow * (x3 - share * driven) + share * by_velocity * velocity - by_load * load


MAX_INSTANT_SHARE = 1.0 + 1e-6
"""Share of a piece up to which an instant counts as within it: what rounding may add."""
SHORTEST_LAG_S = 1e-30
"""Time constant of a filter that is none, s: not to divide by 0."""
SERIES_TERMS = 9
"""Terms of the series of the filter's last moment, 1: to 1e-9, as `exp_minus`."""


class SensorLaw(NamedTuple):
    """How the sensors of one candidate show spool, pressure and jack."""

    spool_offset: Any
    pressure_offset: Any
    position_offset: Any
    """Constant errors, m, Pa, m."""
    spool_gain: Any
    pressure_gain: Any
    position_gain: Any
    """What is shown over what is there; of the spool about the middle, and."""
    lead: Any
    """All are sampled so long before the end of the tick, s."""
    lag: Any
    """Time constant of the filter before the converters of spool and pressure, s; 0: none."""
    spool_even: Any
    spool_odd: Any
    """What its gain grows by with the position (1/m) and its square (1/m²)."""
    pressure_even: Any
    pressure_odd: Any
    """The same of the pressure, 1/Pa and 1/Pa²."""


@inlined
def sensor_law(c: PlantConstants) -> SensorLaw:
    """Precombine what the sensors' laws need (PHY-33 to PHY-36)."""
    return SensorLaw(
        c.OXS,
        c.OPD,
        c.OXJ,
        1.0 + c.GXS,
        1.0 + c.GPD,
        1.0 + c.GXJ,
        c.DLY,
        c.TAU,
        c.BX2 / c.XSM,
        c.BX3 / (c.XSM * c.XSM),
        c.BP2 / c.PSR,
        c.BP3 / (c.PSR * c.PSR),
    )


@packed
def read_spool(law: SensorLaw, place: Any) -> Any:
    """What the spool's sensor reads of a position (m), but for noise and rounding."""
    bent = place * (law.spool_even + law.spool_odd * place)
    return law.spool_offset + place * (law.spool_gain + bent)


@packed
def read_pressure(law: SensorLaw, p12: Any) -> Any:
    """What the sensor of differential pressure reads of one (Pa), but for noise and rounding."""
    bent = p12 * (law.pressure_even + law.pressure_odd * p12)
    return law.pressure_offset + p12 * (law.pressure_gain + bent)


@inlined
def has_sensor_dynamics(law: SensorLaw) -> bool:
    """Whether spool and pressure are seen otherwise than at the end of the tick."""
    return law.lag > 0.0 or law.lead > 0.0


class FilterStep(NamedTuple):
    """How the filter's output hangs on a cubic a0 + a1 u + a2 u² + a3 u³ and on itself before."""

    keep: Any
    """Share of the output before that is left."""
    m0: Any
    m1: Any
    m2: Any
    m3: Any
    """Weights of the cubic's coefficients."""


@packed
def filter_step(lag: Any, span: Any, upto: Any) -> FilterStep:
    """Follow a cubic of a duration `span` from its start for `upto` seconds; lag 0: the cubic.

    Weights are u^k times the moments of exp((s - 1) z) z over s^k, 0 < s < 1, with u the share of
    the span and z of the time constant. Each follows from the next one by parts; with a small z
    they begin with a series of the last, else with the first. Numbers or vectors.
    """
    u, z = upto / span, maximum(upto, 0.0 * upto) / maximum(lag, SHORTEST_LAG_S)
    short, longer, by_z = minimum(z, 1.0), z > 1.0, 1.0 / maximum(z, 1.0)
    m3 = short / (4.0 + SERIES_TERMS)
    for k in range(SERIES_TERMS):
        m3 = short / (3.0 + SERIES_TERMS - k) * (1.0 - m3)
    m2 = short / 3.0 * (1.0 - m3)
    m1 = short / 2.0 * (1.0 - m2)
    m0 = where(longer, 1.0 - exp_minus(z), short * (1.0 - m1))
    m1 = where(longer, 1.0 - by_z * m0, m1)
    m2 = where(longer, 1.0 - 2.0 * by_z * m1, m2)
    m3 = where(longer, 1.0 - 3.0 * by_z * m2, m3)
    return FilterStep(1.0 - m0, m0, u * m1, u * u * m2, u * u * u * m3)


@packed
def filter_output(f: FilterStep, before: Any, cubic: Any) -> Any:
    """Output of the filter after a cubic, its four coefficients; `before`: output at its start."""
    return f.keep * before + f.m0 * cubic[0] + f.m1 * cubic[1] + f.m2 * cubic[2] + f.m3 * cubic[3]


@packed
def cubic_through_ends(x0: Any, x1: Any, rise0: Any, rise1: Any) -> Any:
    """Coefficients of the cubic with these ends and slopes (by du) there."""
    gain = x1 - x0
    return x0, rise0, 3.0 * gain - 2.0 * rise0 - rise1, rise0 + rise1 - 2.0 * gain


def _inverse() -> list[list[float]]:
    """Coefficients of u, u², u³, a row each, of the cubics that are 1 at C1, C2 or 1 and else 0."""
    table: list[list[float]] = np.linalg.inv(
        np.vander([RADAU.c1, RADAU.c2, 1.0], 4, increasing=True)[:, 1:]
    ).tolist()
    return table


(B11, B12, B13), (B21, B22, B23), (B31, B32, B33) = _inverse()


@packed
def cubic_through_stages(p0: Any, p1: Any, p2: Any, p3: Any) -> Any:
    """Coefficients of the cubic with these values at 0, C1, C2 and 1."""
    d1, d2, d3 = p1 - p0, p2 - p0, p3 - p0
    return (
        p0,
        B11 * d1 + B12 * d2 + B13 * d3,
        B21 * d1 + B22 * d2 + B23 * d3,
        B31 * d1 + B32 * d2 + B33 * d3,
    )


class PathPiece(NamedTuple):
    """Piece of the spool's path, a cubic; numbers, or vectors of as many lanes."""

    span: Any
    """Duration, s."""
    x0: Any
    x1: Any
    """Spool at its ends, m."""
    rise0: Any
    rise1: Any
    """Slopes there times `span`, m."""


@packed
def position_on_piece(p: PathPiece, q: Any) -> Any:
    """Spool at the share q of a piece, m."""
    r = 1.0 - q
    return p.x0 + q * q * (3.0 - 2.0 * q) * (p.x1 - p.x0) + q * r * (r * p.rise0 - q * p.rise1)


@packed
def sample_pressure(
    lag: Any, upto: Any, span: Any, these: Mask, cubic: Any, lagged: Any, seen: Any
) -> tuple[Vector, Vector]:
    """Pressure behind the filter after a step, and when it was sampled last, Pa, of these lanes.

    lag: see `SensorLaw`; upto: from the start of the step to the instant of sampling, s, none of
    this step if not positive or beyond it; span: of the step, s; cubic: coefficients of the
    pressure over it; lagged, seen: before, Pa.
    """
    samples = these & (upto > 0.0) & (upto <= MAX_INSTANT_SHARE * span)
    if any_lane(samples):
        at_sampling = filter_output(filter_step(lag, span, upto), lagged, cubic)
        seen = where(samples, at_sampling, seen)
    at_end = filter_output(filter_step(lag, span, span), lagged, cubic)
    return where(these, at_end, lagged), seen
