"""Compiled integration of torque motor, spool, second stage and jack over one control tick.

Each sub-step takes flapper, spool, pressure and jack in the order of the chain. Forces that grow
with a mass's own velocity are implicit (the hydraulic ones have time constants of microseconds),
the rest is explicit; dry friction follows Borello's algorithm (model.md section 1).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag_sim.plant.coefficients import Coefficients

__all__ = ["BALL", "DXF", "DXJ", "DXS", "MOTOR", "P12", "STATES", "XF", "XJ", "XS", "step_tick"]

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
MOTOR = 7
"""Current behind the torque motor's hysteresis, A."""
BALL = 8
"""Position of the feedback ball behind the backlash, m."""
STATES = 9


@kernel
def play(held: float, value: float, half_width: float) -> float:
    """Play operator: `held` follows `value` at a distance of at most `half_width`."""
    return max(value - half_width, min(value + half_width, held))


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
def step_tick(
    state: NDArray[np.float64],
    p: Coefficients,
    current: float,
    step: float,
    substeps: int,
) -> None:
    """Advance `state` (shape (STATES,), in place) by `substeps` steps of `step` s at one current.

    `current` is the servovalve current in A that the control computer holds.
    """
    xf, dxf = state[XF], state[DXF]
    xs, dxs = state[XS], state[DXS]
    xj, dxj = state[XJ], state[DXJ]
    p12, ball = state[P12], state[BALL]
    state[MOTOR] = play(state[MOTOR], current, p.HYSTERESIS)
    torque = p.GM * state[MOTOR]
    per_flapper = 1.0 / (p.JF + step * p.CF)
    per_spool = 1.0 / (p.MS + step * p.DAMPING)
    per_jack_free = 1.0 / (p.MJ + step * p.CJ)
    knee = p.PSR / p.GP
    stiffness = p.GP / p.GQ
    share = 1.0 / (1.0 + stiffness * p.CLK)
    drag = share * stiffness * p.AJ
    per_jack = 1.0 / (p.MJ + step * (p.AJ * drag + p.CJ))

    for _ in range(substeps):
        dxf = (p.JF * dxf + step * (torque - p.KSF * ball - p.KF * xf)) * per_flapper
        xf += step * dxf
        if abs(xf) >= p.XFM:
            xf = math.copysign(p.XFM, xf)
            dxf = 0.0

        dxs = velocity_after(p.MS * dxs, p.FORCE * xf, step, per_spool, p.FSS, p.FDS)
        xs += step * dxs
        if abs(xs) >= p.XSM:
            xs = math.copysign(p.XSM, xs)
            dxs = 0.0
        ball = play(ball, xs, p.BACKLASH)

        blocked = share * p.GP * xs  # pressure at zero jack velocity
        slope, per = drag, per_jack
        if abs(xs) > knee:
            beyond = p.PSR / (p.GQ * abs(xs))
            part = 1.0 / (1.0 + beyond * p.CLK)
            blocked = part * math.copysign(p.PSR, xs)
            slope = part * beyond * p.AJ
            per = 1.0 / (p.MJ + step * (p.AJ * slope + p.CJ))
        momentum = p.MJ * dxj
        dxj = velocity_after(momentum, p.AJ * blocked - p.FR, step, per, p.FSJ, p.FDJ)
        p12 = blocked - slope * dxj
        if abs(p12) > p.PSR:
            # A jack driven back against the valve: the pressure cannot exceed the supply.
            p12 = math.copysign(p.PSR, p12)
            dxj = velocity_after(momentum, p.AJ * p12 - p.FR, step, per_jack_free, p.FSJ, p.FDJ)
        xj += step * dxj
        if abs(xj) >= p.XJM:
            xj = math.copysign(p.XJM, xj)
            dxj = 0.0
            p12 = blocked

    state[XF], state[DXF] = xf, dxf
    state[XS], state[DXS] = xs, dxs
    state[XJ], state[DXJ] = xj, dxj
    state[P12], state[BALL] = p12, ball
