"""Compiled integration of flapper, spool, second stage and jack over a span of constant torque.

Each sub-step takes flapper, spool, pressure and jack in the order of the chain. Forces that grow
with a mass's own velocity are implicit (the hydraulic ones have time constants of microseconds),
the rest is explicit; dry friction follows Borello's algorithm (PHY-8).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag_sim.plant.coefficients import Coefficients

__all__ = [
    "BALL",
    "DXF",
    "DXJ",
    "DXS",
    "P12",
    "P12_SEEN",
    "STATES",
    "XF",
    "XJ",
    "XS",
    "XS_SEEN",
    "advance",
]

XF = 0
"""Flapper displacement, m."""
DXF = 1
"""Flapper velocity, m/s."""
XS = 2
"""Spool position, m."""
DXS = 3
"""Spool velocity, m/s."""
XJ = 4
"""Jack position, m."""
DXJ = 5
"""Jack velocity, m/s."""
P12 = 6
"""Differential pressure, Pa."""
BALL = 7
"""Position of the feedback ball behind the backlash, m."""
XS_SEEN = 8
"""Spool position behind the analogue filter, m."""
P12_SEEN = 9
"""Differential pressure behind the analogue filter, Pa."""
STATES = 10


@kernel
def velocity_after(
    momentum: float, force: float, step: float, per_mass: float, static: float, dynamic: float
) -> float:
    """Velocity of a mass with dry friction after one step (Borello's algorithm).

    `momentum` is mass times velocity before, `force` all but dry friction and the viscous force,
    which is implicit: `per_mass` = 1/(mass + step·viscous coefficient). A change of sign within
    the step stops at exactly zero, so that the next step decides between sticking and breaking
    away.
    """
    if momentum == 0.0:
        friction = max(-static, min(static, force))
    elif momentum > 0.0:
        friction = dynamic
    else:
        friction = -dynamic
    after = (momentum + step * (force - friction)) * per_mass
    if momentum * after < 0.0:
        return 0.0
    return after


@kernel
def stribeck(static: float, dynamic: float, speed: float, scale: float) -> float:
    """Friction of a mass that moves, N: FD + (FS - FD)·exp(-|v|/vS) (PHY-31)."""
    return dynamic + (static - dynamic) * math.exp(-abs(speed) / scale)


@kernel
def orifice_flow(opening: float, share: float, underlap: float, gain: float) -> float:
    """Flow through two lands into the chambers, m³/s (PHY-39).

    `opening` is the spool's position against the lands in m, `share` P12/PSR, `gain` GQ.
    """
    first = max(opening + underlap, 0.0)
    second = max(underlap - opening, 0.0)
    ahead, behind = 1.0 - share, 1.0 + share
    return gain * (
        first * math.copysign(math.sqrt(abs(ahead)), ahead)
        - second * math.copysign(math.sqrt(abs(behind)), behind)
    )


@kernel
def advance(
    state: NDArray[np.float64],
    p: Coefficients,
    torque: float,
    step: float,
    substeps: int,
) -> None:
    """Advance `state` (shape (STATES,), in place) by `substeps` steps of `step` s.

    `torque` is that of the torque motor on the flapper, N m, constant meanwhile.
    """
    xf, dxf = state[XF], state[DXF]
    xs, dxs = state[XS], state[DXS]
    xj, dxj = state[XJ], state[DXJ]
    p12, ball = state[P12], state[BALL]
    xs_seen, p12_seen = state[XS_SEEN], state[P12_SEEN]
    per_flapper = 1.0 / (p.JF + step * p.CF)
    per_spool = 1.0 / (p.MS + step * p.DAMPING)
    per_jack_free = 1.0 / (p.MJ + step * p.CJ)
    knee = p.PSR / p.GP
    stiffness = p.GP / p.GQ
    share = 1.0 / (1.0 + stiffness * p.CLK)
    drag = share * stiffness * p.AJ
    per_jack = 1.0 / (p.MJ + step * (p.AJ * drag + p.CJ))
    per_knee = 1.0 / p.PSR
    oil_step = step * p.OIL
    per_oil = 1.0 / (1.0 + oil_step * p.CLK)
    filtered = p.TAU > 0.0
    follow = 1.0 - math.exp(-step / p.TAU) if filtered else 1.0
    fss, fds = p.FSS, p.FDS
    fsj, fdj = p.FSJ, p.FDJ
    varies = p.VSS > 0.0 or p.VSJ > 0.0 or p.WAY != 0.0 or p.SLEEVE != 0.0

    for _ in range(substeps):
        if varies:
            fss = p.FSS * (1.0 + p.SLEEVE * xs)
            fds = 0.5 * fss
            if p.VSS > 0.0:
                fds = stribeck(fss, fds, dxs, p.VSS)
            way = dxj if dxj != 0.0 else p12
            fsj = p.FSJ * (1.0 + math.copysign(p.WAY, way * p.WAY))
            fdj = 0.5 * fsj
            if p.VSJ > 0.0:
                fdj = stribeck(fsj, fdj, dxj, p.VSJ)

        dxf = (p.JF * dxf + step * (torque - p.KSF * ball - p.KF * xf)) * per_flapper
        xf += step * dxf
        if abs(xf) >= p.XFM:
            xf = math.copysign(p.XFM, xf)
            dxf = 0.0

        dxs = velocity_after(p.MS * dxs, p.FORCE * xf, step, per_spool, fss, fds)
        xs += step * dxs
        if abs(xs) >= p.XSM:
            xs = math.copysign(p.XSM, xs)
            dxs = 0.0
        ball = max(xs - p.BACKLASH, min(xs + p.BACKLASH, ball))

        opening = xs - p.NULL
        if p.LAND != 0.0:
            opening *= 1.0 + math.copysign(p.LAND, opening * p.LAND)
        load = p.FR + p.KA * xj
        momentum = p.MJ * dxj
        if p.OIL > 0.0:
            force = p.AJ * p12 - load
            dxj = velocity_after(momentum, force, step, per_jack_free, fsj, fdj)
            xj += step * dxj
            if abs(xj) >= p.XJM:
                xj = math.copysign(p.XJM, xj)
                dxj = 0.0
            flow = orifice_flow(opening, p12 * per_knee, p.U, p.GQ)
            p12 = (p12 + oil_step * (flow - p.AJ * dxj)) * per_oil
        else:
            blocked = share * p.GP * opening  # pressure at zero jack velocity
            slope, per = drag, per_jack
            if abs(opening) > knee:
                beyond = p.PSR / (p.GQ * abs(opening))
                part = 1.0 / (1.0 + beyond * p.CLK)
                blocked = part * math.copysign(p.PSR, opening)
                slope = part * beyond * p.AJ
                per = 1.0 / (p.MJ + step * (p.AJ * slope + p.CJ))
            dxj = velocity_after(momentum, p.AJ * blocked - load, step, per, fsj, fdj)
            p12 = blocked - slope * dxj
            if abs(p12) > p.PSR:
                # A jack driven back against the valve: the pressure cannot exceed the supply.
                p12 = math.copysign(p.PSR, p12)
                force = p.AJ * p12 - load
                dxj = velocity_after(momentum, force, step, per_jack_free, fsj, fdj)
            xj += step * dxj
            if abs(xj) >= p.XJM:
                xj = math.copysign(p.XJM, xj)
                dxj = 0.0
                p12 = blocked
        if filtered:
            xs_seen += follow * (xs - xs_seen)
            p12_seen += follow * (p12 - p12_seen)

    if not filtered:
        xs_seen, p12_seen = xs, p12
    state[XF], state[DXF] = xf, dxf
    state[XS], state[DXS] = xs, dxs
    state[XJ], state[DXJ] = xj, dxj
    state[P12], state[BALL] = p12, ball
    state[XS_SEEN], state[P12_SEEN] = xs_seen, p12_seen
