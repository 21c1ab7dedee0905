"""One step of the sliding jack with a linear second stage, of numbers or of vectors of lanes.

Radau's collocation of order 5 (IIA, three stages; Hairer, Wanner, Solving Ordinary Differential
Equations II, section IV.5), which damps what is stiff. Unknown are the pressures of the stages, not
the velocities: the second stage reads P12 = (flow x - v) / e at any x (`ehadiag.model.laws`), so
the stages' equations are linear with coefficients that need no division, no branch and no
exponential, and a step takes one division, for the last stage's pressure.
"""

from __future__ import annotations

import math
from typing import Any

from ehadiag.compile.vector import most, packed
from ehadiag.model.laws import JackLaw, creeping

__all__ = ["C1", "C2", "creeping_pressures", "radau_pressures", "radau_velocity"]

REPETITIONS = 3
ROOT = math.sqrt(6.0)
C1, C2 = (4.0 - ROOT) / 10.0, (4.0 + ROOT) / 10.0
"""Where the stages of a step stand in it, beside its end."""
A11, A12, A13 = (
    (88.0 - 7.0 * ROOT) / 360.0,
    (296.0 - 169.0 * ROOT) / 1800.0,
    (3.0 * ROOT - 2.0) / 225.0,
)
A21, A22, A23 = (
    (296.0 + 169.0 * ROOT) / 1800.0,
    (88.0 + 7.0 * ROOT) / 360.0,
    -(3.0 * ROOT + 2.0) / 225.0,
)
A31, A32, A33 = (16.0 - ROOT) / 36.0, (16.0 + ROOT) / 36.0, 1.0 / 9.0


@packed
def _solved(
    j: JackLaw, h: Any, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any, g1: Any, g2: Any, g3: Any,
) -> Any:  # fmt: skip
    """Pressures (Pa) at the three stages of a step of `h` seconds of the moving jack.

    load: external and friction force at its start, N; x1, x2, x3: spool at the three stages, m;
    e1, e2, e3: `resistance` there; g1, g2, g3: more force there, N. Numbers or vectors of them.
    """
    k = h * j.by_mass
    thrust, drag = k * j.area, k * j.viscosity
    y1, y2, y3 = j.flow * x1, j.flow * x2, j.flow * x3
    f1, f2, f3 = thrust + drag * e1, thrust + drag * e2, thrust + drag * e3
    # The load spring's force grows with the travel.
    pull, more = k * load, 0.5 * h * k * j.spring * velocity
    z1 = y1 + drag * (A11 * y1 + A12 * y2 + A13 * y3) + C1 * pull + C1 * C1 * more - velocity
    z2 = y2 + drag * (A21 * y1 + A22 * y2 + A23 * y3) + C2 * pull + C2 * C2 * more - velocity
    z3 = y3 + drag * (A31 * y1 + A32 * y2 + A33 * y3) + pull + more - velocity
    m11, m12, m13 = e1 + A11 * f1, A12 * f2, A13 * f3
    m21, m22, m23 = A21 * f1, e2 + A22 * f2, A23 * f3
    m31, m32, m33 = A31 * f1, A32 * f2, e3 + A33 * f3
    if g1 is not None:
        z1 = z1 + k * (A11 * g1 + A12 * g2 + A13 * g3)
        z2 = z2 + k * (A21 * g1 + A22 * g2 + A23 * g3)
        z3 = z3 + k * (A31 * g1 + A32 * g2 + A33 * g3)
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
    return _solved(j, h, load, velocity, x1, x2, x3, e1, e2, e3, None, None, None)


@packed
def creeping_pressures(
    j: JackLaw, h: Any, load: Any, d: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any,
) -> Any:  # fmt: skip
    """Pressures (Pa) at the three stages, Stribeck's friction included.

    Arguments as of `radau_velocity`; d: direction of the motion. What the oil resists is far more
    than what friction gains by velocity, so that a few repetitions find it.
    """
    g = d * creeping(j, velocity * d)
    p1, p2, p3 = _solved(j, h, load, velocity, x1, x2, x3, e1, e2, e3, g, g, g)
    for _ in range(REPETITIONS):
        g1 = d * creeping(j, most((j.flow * x1 - e1 * p1) * d, x1 * 0.0))
        g2 = d * creeping(j, most((j.flow * x2 - e2 * p2) * d, x1 * 0.0))
        g3 = d * creeping(j, most((j.flow * x3 - e3 * p3) * d, x1 * 0.0))
        p1, p2, p3 = _solved(j, h, load, velocity, x1, x2, x3, e1, e2, e3, g1, g2, g3)
    return p1, p2, p3


@packed
def radau_velocity(
    j: JackLaw, h: Any, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any,
) -> Any:  # fmt: skip
    """Velocity (m/s) of the moving jack after a step of `h` seconds, Stribeck's friction left out.

    load: external and dynamic friction force at its start, N; x1, x2, x3: spool at the three
    stages, m; e1, e2, e3: `resistance` there. Numbers or vectors of them.
    """
    p3 = radau_pressures(j, h, load, velocity, x1, x2, x3, e1, e2, e3)[2]
    return j.flow * x3 - e3 * p3
