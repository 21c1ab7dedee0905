"""Orifice stage and jack of many candidates over a step, one lane each.

One step of `ehadiag.model.orifice` for all lanes; a lane whose jack stops, starts or meets its
bound takes that step alone (`ehadiag.model.simd.jack_events`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined
from ehadiag.compile.vector import WIDTH, anywhere, least, load, magnitude, packed, store, where
from ehadiag.model.orifice import CREEPING, LONGEST, STEEPEST, orifice_rate, orifice_step
from ehadiag.model.sensors import through_ends
from ehadiag.model.simd.jack import END, MIDDLE, STAGE_NUMBERS, START, follow_pressure, place_at
from ehadiag.model.simd.jack_events import jack_events
from ehadiag.model.simd.layout import (
    BUSY,
    DONE,
    JACK,
    JACK_DIRECTION,
    JACK_VELOCITY,
    LANES,
    MOST_HALVINGS,
    PRESSURE,
    jack_law_of_lane,
    jack_laws,
)

__all__ = ["orifice_level", "orifice_tick", "sensed_orifice_tick"]

FEWEST_HALVINGS = 2
"""The nodes of the spool's path are then ends of steps."""
COARSEST = 2.0 * LONGEST
"""Step in radians of the ringing from which a lane goes alone."""


@inlined
def orifice_level(tick: float, coefficients: NDArray[np.float64]) -> int:
    """Halvings of a tick (s) for the lane that rings fastest."""
    fastest = 0.0
    for i in range(LANES):
        j = jack_law_of_lane(coefficients, i)
        fastest = max(fastest, math.sqrt(j.oil * j.area * j.by_mass))
    wanted = math.ceil(math.log2(max(tick * fastest / LONGEST, 1.0)) - 1e-9)
    return min(max(wanted, FEWEST_HALVINGS), MOST_HALVINGS)


def _lanes(senses: bool) -> Any:
    """Compiled step of all lanes, with or without the sensor of pressure."""

    @packed
    def lanes(
        end: int,
        level: int,
        step: int,
        tick: float,
        state: NDArray[np.float64],
        path: NDArray[np.float64],
        coefficients: NDArray[np.float64],
    ) -> bool:
        any_busy = False
        h = tick / (1 << level)
        k = ((level << MOST_HALVINGS) + step) * STAGE_NUMBERS
        for o in range(0, end, WIDTH):
            j = jack_laws(coefficients, o)
            place, velocity = load(state, JACK * LANES + o), load(state, JACK_VELOCITY * LANES + o)
            d, p12 = load(state, JACK_DIRECTION * LANES + o), load(state, PRESSURE * LANES + o)
            x0, x2 = place_at(path, o, k + START, tick), place_at(path, o, k + END, tick)
            x1 = place_at(path, o, k + MIDDLE, tick)
            force = j.load + j.spring * (place + 0.5 * h * velocity)
            p, v, travel = orifice_step(j, h, force, d, x0, x1, x2, p12, velocity)
            push = j.area * p - j.load - j.spring * place
            held = magnitude(push) <= j.static
            held = held | ((magnitude(place) >= j.stroke) & (place * push > 0.0))
            slides = (v * d > 0.0) & (magnitude(place + travel) < j.stroke)
            done = load(state, DONE * LANES + o) != 0.0
            goes = (((d == 0.0) & held) | slides) & ~done
            goes = goes & (j.oil * j.area * j.by_mass * (h * h) < COARSEST * COARSEST)
            steep = j.extra * j.by_stribeck * j.by_mass * h > STEEPEST
            slow = least(magnitude(velocity), magnitude(v)) * j.by_stribeck < CREEPING
            goes = goes & ~(steep & slow & (d != 0.0))
            if senses:
                cubic = through_ends(
                    p12, p,
                    h * orifice_rate(j, x0, p12, velocity), h * orifice_rate(j, x2, p, v),
                )  # fmt: skip
                follow_pressure(cubic, goes, level, step, o, state, coefficients)
            store(state, PRESSURE * LANES + o, where(goes, p, p12))
            store(state, JACK_VELOCITY * LANES + o, where(goes, v, velocity))
            store(state, JACK * LANES + o, where(goes, place + travel, place))
            store(state, BUSY * LANES + o, where(goes | done, 0.0, 1.0))
            if anywhere(~(goes | done)):
                any_busy = True
        return any_busy

    return lanes


def _ticks(senses: bool) -> Any:
    """Compiled tick of all lanes, with or without the sensor of pressure."""
    lanes = _lanes(senses)

    @bare_kernel
    def ticks(
        count: int,
        end: int,
        tick: float,
        level: int,
        state: NDArray[np.float64],
        path: NDArray[np.float64],
        coefficients: NDArray[np.float64],
    ) -> None:
        for step in range(1 << level):
            if lanes(end, level, step, tick, state, path, coefficients):
                jack_events(count, level, step, tick, state, path, coefficients)

    return ticks


orifice_tick, sensed_orifice_tick = _ticks(False), _ticks(True)
"""Compiled: jack of all lanes over a tick cut into 2^level steps; with the second one their
pressure as the filter before its converter has it."""
