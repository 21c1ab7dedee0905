"""Runs of the model at a point: passes of streaming monitors over the recording."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.model.laws import ESTIMATED_BEND, SpoolLaw
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.layout import NUMBER, RESIDUAL, SETTINGS, SPOOL_LAW, Settings
from ehadiag.monitor.layout import SIZE as MONITOR_SIZE
from ehadiag.monitor.prepare import PLAN_SETTINGS, UNIT_SIZE, prepare
from ehadiag.onboard.layout import (
    BELIEF,
    GENES,
    LANES,
    MONITORS,
    NOISE,
    PARAMETERS,
    RUNS,
    SIZE,
    UNIT,
)

__all__ = [
    "PRESSURE_WEIGHT",
    "SPOOL_WEIGHT",
    "lines",
    "loosen",
    "push_lanes",
    "run_model",
    "start_cross",
    "start_lane",
    "vector_at",
]

Array = NDArray[np.float64]
SPOOL_WEIGHT = PLAN_SETTINGS + Settings._fields.index("spool_weight")
PRESSURE_WEIGHT = PLAN_SETTINGS + Settings._fields.index("pressure_weight")
"""Where the plan has the reciprocal noise."""
ANCHOR_SMALL = SETTINGS + Settings._fields.index("anchor_small")
ANCHOR_LARGE = SETTINGS + Settings._fields.index("anchor_large")
BEND = SPOOL_LAW + SpoolLaw._fields.index("bend")
REACH = 3.0
"""Variances of a belief from its mean to the points on an axis."""
ONE_SIDED = 0.25
"""See `ehadiag.identify.refine.linearisation`, for both."""


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
    wrong = int(prepare(place, plan_address, address + NUMBER * UNIT))
    numbers = array_at(place, (MONITOR_SIZE,))
    numbers[BEND] = min(numbers[BEND], ESTIMATED_BEND)
    return wrong


@inlined_exact
def loosen(address: int, lane: int, factor: float) -> None:
    """Widen what a model may be off before it is put back on the spool."""
    numbers = array_at(address + NUMBER * (LANES + lane * MONITOR_SIZE), (MONITOR_SIZE,))
    numbers[ANCHOR_SMALL] *= factor
    numbers[ANCHOR_LARGE] *= factor


@brief_kernel
def run_model(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int, point: Array,
    cap: float,
) -> tuple[float, float]:  # fmt: skip
    """Run the model once at a point, free: capped sums of squares of spool and pressure."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    start_lane(address, plan_address, plan, 0, point)
    loosen(address, 0, math.inf)
    place = address + NUMBER * LANES
    spool, pressure = 0.0, 0.0
    for k in range(count):
        push_tick(place, (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]))
        a, b = p[LANES + RESIDUAL], p[LANES + RESIDUAL + 1]
        if math.isfinite(a):
            spool += min(a * a, cap)
        if math.isfinite(b):
            pressure += min(b * b, cap)
    p[RUNS] += 1.0
    return spool, pressure


@brief_kernel
def start_cross(
    address: int, plan_address: int, plan: Array, point: Array, trial: Array, along: Array
) -> None:
    """Prepare a model at a point, and two on each severity's axis through it.

    Parameters
    ----------
    address : int
        Of the identification.
    plan_address : int
        Of its plan.
    plan : Array
        The plan.
    point : Array
        Shape (PARAMETERS,).
    trial : Array
        Shape (PARAMETERS,), overwritten by the mean of all points.
    along : Array
        Shape (GENES, 3): where on its axis each stands, from the mean of the three.
    """
    p = array_at(address, (SIZE,))
    for i in range(PARAMETERS):
        trial[i] = point[i]
    start_lane(address, plan_address, plan, 0, trial)
    for i in range(GENES):
        width = 0.0
        for j in range(GENES):
            width += p[BELIEF + i * GENES + j] ** 2
        width = math.sqrt(REACH * width)
        above, below = min(width, 1.0 - point[i]), min(width, point[i])
        if below < ONE_SIDED * width:
            below = -0.5 * above
        elif above < ONE_SIDED * width:
            above = -0.5 * below
        trial[i] = point[i] + above
        start_lane(address, plan_address, plan, 1 + 2 * i, trial)
        trial[i] = point[i] - below
        start_lane(address, plan_address, plan, 2 + 2 * i, trial)
        trial[i] = point[i]
        middle = (above - below) / 3.0
        along[i, 0], along[i, 1], along[i, 2] = -middle, above - middle, -below - middle
    for i in range(GENES):
        trial[i] += 3.0 * -along[i, 0] / MONITORS
    for lane in range(MONITORS):
        loosen(address, lane, p[NOISE])


@brief_kernel
def push_lanes(address: int, sample: tuple[float, float, float, float, float]) -> int:
    """Advance all models by a tick."""
    for lane in range(MONITORS):
        push_tick(address + NUMBER * (LANES + lane * MONITOR_SIZE), sample)
    return 0


@inlined_exact
def lines(p: Array, channel: int, along: Array, slope: Array) -> tuple[float, float]:
    """Fit a line to the residuals of a channel on each axis.

    Parameters
    ----------
    p : Array
        Numbers of the identification, its models advanced.
    channel : int
        0 spool, 1 pressure.
    along : Array
        See `start_cross`.
    slope : Array
        Shape (PARAMETERS,), overwritten by the slopes, in units of the noise.

    Returns
    -------
    tuple[float, float]
        Mean of all points' residuals, and scatter about the lines.
    """
    noise, at = p[NOISE + channel], LANES + RESIDUAL + channel
    middle = p[at] / noise
    total, scatter = middle, 0.0
    for i in range(GENES):
        up = p[at + (1 + 2 * i) * MONITOR_SIZE] / noise
        down = p[at + (2 + 2 * i) * MONITOR_SIZE] / noise
        total += up + down
        a, b, c = along[i, 0], along[i, 1], along[i, 2]
        slope[i] = (a * middle + b * up + c * down) / (a * a + b * b + c * c)
        mean = (middle + up + down) / 3.0
        scatter += (
            (middle - mean - a * slope[i]) ** 2
            + (up - mean - b * slope[i]) ** 2
            + (down - mean - c * slope[i]) ** 2
        )
    slope[GENES] = slope[GENES + 1] = 0.0
    slope[GENES + channel] = -1.0 / noise
    return total / MONITORS, scatter / GENES
