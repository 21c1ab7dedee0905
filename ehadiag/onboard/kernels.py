"""The identification itself, as two kernels: begin, and go on for some runs of the model.

First approximation: a grid of filter and spool friction by the spool alone, then one of the jack's
friction by the pressure. The compact genetic algorithm goes on from there. Then noise and offsets
are judged, and a belief about severities and both offsets is sharpened. One run of the model is a
pass of the streaming monitor over the recording.
"""

from __future__ import annotations

import math

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel
from ehadiag.monitor.layout import NUMBER
from ehadiag.monitor.prepare import UNIT_SIZE, prepare
from ehadiag.onboard.approximate import approximate, take_offsets
from ehadiag.onboard.examine import examine
from ehadiag.onboard.layout import (
    CONCLUSION,
    DONE,
    GENES,
    GRIDS,
    JACK,
    LANES,
    LOOK,
    POINT,
    REFINEMENT,
    RUNS,
    SEARCH,
    SIZE,
    TRIAL,
    UNIT,
    Advance,
    advance_of,
    keep_advance,
)
from ehadiag.onboard.noise import look
from ehadiag.onboard.refine import refine
from ehadiag.onboard.rules import PLAN_SIZE
from ehadiag.onboard.search import search

__all__ = ["begin_identification", "identify_some"]


@brief_kernel
def begin_identification(address: int, plan_address: int, unit_address: int) -> int:
    """Begin an identification; the unit's severities and offsets are where the offsets start.

    Parameters
    ----------
    address : int
        Of the SIZE numbers of `ehadiag.onboard.layout`.
    plan_address : int
        Of a plan with rules, see `ehadiag.onboard.rules`.
    unit_address : int
        Of the numbers of a `Unit`: viscosity, supply and kind of the commands hold.

    Returns
    -------
    int
        0; 1: a number of the unit is out of its range.
    """
    p, unit = array_at(address, (SIZE,)), array_at(unit_address, (UNIT_SIZE,))
    if prepare(address + NUMBER * LANES, plan_address, unit_address) != 0:
        return 1
    for i in range(LANES):
        p[i] = 0.0
    for i in range(UNIT_SIZE):
        p[UNIT + i] = unit[i]
    keep_advance(p, Advance(GRIDS, 0.0, math.inf, 0.0, 0.0))
    p[POINT + 2] = 0.3
    for i in range(GENES):
        p[TRIAL + i] = p[POINT + i]
    return 0


@brief_kernel
def identify_some(
    address: int, plan_address: int, ticks_address: int, amounts: tuple[float, float]
) -> int:
    """Go on with an identification for at least so many runs of the model, or to its end.

    Parameters
    ----------
    address : int
        Of an identification that was begun.
    plan_address : int
        Of the plan that it was begun with.
    ticks_address : int
        Of the recorded test, five numbers a tick, the same in every call.
    amounts : tuple[float, float]
        Ticks of the recording, at least 100 and at most 1e6; runs of the model.

    Returns
    -------
    int
        0: done; 1: to be gone on with; 2: an amount is out of its range.
    """
    if not (100.0 <= amounts[0] <= 1e6 and amounts[1] >= 1.0):
        return 2
    p, plan = array_at(address, (SIZE,)), array_at(plan_address, (PLAN_SIZE,))
    count = int(amounts[0])
    ticks = array_at(ticks_address, (count, 5))
    until = p[RUNS] + amounts[1]
    while p[RUNS] < until:
        a = advance_of(p)
        if a.phase == GRIDS and a.steps == 0.0:
            take_offsets(p, plan, ticks, count)
        if a.phase in (GRIDS, JACK):
            approximate(address, plan_address, plan, ticks_address, count)
        elif a.phase == SEARCH:
            search(address, plan_address, plan, ticks_address, count)
        elif a.phase == LOOK:
            look(address, plan_address, plan, ticks_address, count)
        elif a.phase == REFINEMENT:
            refine(address, plan_address, plan, ticks_address, count)
        elif a.phase == CONCLUSION:
            examine(address, plan_address, plan, ticks_address, count)
        else:
            break
    return 0 if advance_of(p).phase == DONE else 1
