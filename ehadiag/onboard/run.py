"""One run of the model at a point: a pass of the streaming monitor over the recording."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.layout import NUMBER, RESIDUAL, SETTINGS, Settings
from ehadiag.monitor.layout import SIZE as MONITOR_SIZE
from ehadiag.monitor.prepare import PLAN_SETTINGS, UNIT_SIZE, prepare
from ehadiag.onboard.layout import GENES, LANES, PARAMETERS, RUNS, SIZE, UNIT

__all__ = ["PRESSURE_WEIGHT", "SPOOL_WEIGHT", "run_model", "start_lane", "vector_at"]

Array = NDArray[np.float64]
SPOOL_WEIGHT = PLAN_SETTINGS + Settings._fields.index("spool_weight")
PRESSURE_WEIGHT = PLAN_SETTINGS + Settings._fields.index("pressure_weight")
"""Where the plan has the reciprocal noise."""
ANCHOR_SMALL = SETTINGS + Settings._fields.index("anchor_small")
ANCHOR_LARGE = SETTINGS + Settings._fields.index("anchor_large")


@inlined_exact
def vector_at(address: int, place: int) -> Array:
    """Return one number for each parameter, from a place of the memory on."""
    return array_at(address + NUMBER * place, (PARAMETERS,))


@brief_kernel
def start_lane(address: int, plan_address: int, plan: Array, lane: int, point: Array) -> int:
    """Prepare a model at a point."""
    unit = array_at(address + NUMBER * UNIT, (UNIT_SIZE,))
    for i in range(GENES):
        unit[i] = min(max(point[i], 0.0), 1.0)
    unit[3] = point[3] / plan[SPOOL_WEIGHT]
    unit[4] = point[4] / plan[PRESSURE_WEIGHT]
    place = address + NUMBER * (LANES + lane * MONITOR_SIZE)
    return int(prepare(place, plan_address, address + NUMBER * UNIT))


@brief_kernel
def run_model(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int, point: Array,
    anchored: bool, cap: float,
) -> tuple[float, float]:  # fmt: skip
    """Run the model once at a point: capped sums of squares of spool and pressure."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    start_lane(address, plan_address, plan, 0, point)
    place = address + NUMBER * LANES
    lane = array_at(place, (MONITOR_SIZE,))
    if not anchored:
        lane[ANCHOR_SMALL] = lane[ANCHOR_LARGE] = math.inf
    spool, pressure = 0.0, 0.0
    for k in range(count):
        push_tick(place, (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]))
        a, b = lane[RESIDUAL], lane[RESIDUAL + 1]
        if math.isfinite(a):
            spool += min(a * a, cap)
        if math.isfinite(b):
            pressure += min(b * b, cap)
    p[RUNS] += 1.0
    return spool, pressure
