"""One tick of the streaming monitor: the model from a state carried between calls.

Spool, jack and control law are those of `ehadiag.model`; here stand what a lost sample does, and
the sums.
"""

from __future__ import annotations

import math

import numpy as np

from ehadiag.compile.jit import Array, Array2, brief_kernel, inlined, inlined_exact, kernel
from ehadiag.compile.vector import array_at
from ehadiag.model.laws import ControlLaw, ControlState, control_current
from ehadiag.model.sensors import read_pressure, read_spool
from ehadiag.model.simd_jack import sampled_positions
from ehadiag.model.simd_layout import BLOCK, ROWS, block_part, lane_traits, sensor_law_of_lane
from ehadiag.model.simd_spool import anchor_spool_lanes
from ehadiag.model.simd_tick import advance_block
from ehadiag.monitor.monitor_memory import (
    MODEL,
    MONITOR,
    CommandMemory,
    MonitorSettings,
    command_of,
    control_law_of,
    control_of,
    keep_command,
    keep_control,
    model_at,
    settings_of,
)

MAX_EXTRAPOLATED_TICKS = 5.0
"""Ticks for which a lost command is extrapolated, 1; then it is held."""


@inlined
def _followed_command(f: CommandMemory, command: float) -> tuple[CommandMemory, bool]:
    """Command of the tick, and whether it is known: a lost one goes on straight for some ticks."""
    if math.isfinite(command):
        slope = command - f.command if f.lost == 0.0 else 0.0
        return CommandMemory(f.seen, command, slope, 0.0), True
    lost = f.lost + 1.0
    ahead = f.command + f.slope if lost <= MAX_EXTRAPOLATED_TICKS else f.command
    return CommandMemory(f.seen, ahead, f.slope, lost), False


@inlined_exact
def _position_seen(
    s: MonitorSettings, law: ControlLaw, state: ControlState, f: CommandMemory, current: float
) -> float:
    """Digitised jack position that the control law of this tick worked on, m."""
    if math.isfinite(f.seen):
        return float(f.seen)
    if not math.isfinite(current) or law.GAP <= 0.0:
        return float(f.command - state.before)
    place = f.command - current / law.GAP
    if s.invertible != 0.0 and abs(current) < s.linear:
        # One code of position is many codes of current.
        return float(np.round(place / s.code_position) * s.code_position)
    return float(place)


@inlined_exact
def _commanded(
    p: Array, s: MonitorSettings, command: float, current: float, position: float
) -> float:
    """Servovalve current of the tick, A.

    The measured one carries noise: it stands in only where the command is lost and does not go on
    as it was.
    """
    law = control_law_of(p)
    f, received = _followed_command(command_of(p), command)
    if s.closed == 0.0:
        out = min(max(f.command, -law.IM), law.IM)
    else:
        state = control_of(p)
        seen = _position_seen(s, law, state, f, current)
        out, state = control_current(law, state, f.command - seen)
        keep_control(p, state)
    slope = f.slope
    followed = f.command
    if not received and abs(current - out) > s.deviation:
        out = min(max(current, -law.IM), law.IM)
        if s.closed == 0.0:
            followed, slope = out, 0.0
    keep_command(p, CommandMemory(position, followed, slope, f.lost))
    return float(out)


@inlined
def _accumulate(p: Array, s: MonitorSettings, channel: int) -> int:
    """Advance both sums of a channel; one that gave alarm restarts, one of a lost sample stays.

    Returns the sums that gave alarm: 1 for the upper, 2 for the lower one, 3 for both.
    """
    z = p[MONITOR.residual + channel]
    if not math.isfinite(z):
        return 0
    step = min(max(z, -s.limit), s.limit)
    alarms = 0
    for side in range(2):
        at = MONITOR.cusum + 2 * channel + side
        p[at] = max(0.0, p[at] + (step if side == 0 else -step) - s.reference)
        if p[at] > s.threshold:
            alarms += 1 + side
            p[at] = 0.0
    return alarms


@brief_kernel
def push_tick(address: int, sample: tuple[float, float, float, float, float]) -> int:
    """Advance model and sums by one tick, in place; returns the sums that gave alarm.

    address: of the numbers of a monitor; sample: command, current, spool, pressure and position of
    the tick, SI, NaN where lost. Alarms are bits: 1 spool's upper, 2 its lower, 4 pressure's upper,
    8 its lower sum.
    """
    command, current, spool, pressure, position = sample
    p, model = array_at(address, (MONITOR.model,)), model_at(address)
    state = block_part(model, BLOCK.state, BLOCK.path)
    coefficients = block_part(model, BLOCK.coefficients, BLOCK.moving)
    s, tick = settings_of(p), control_law_of(p).tick
    sensor, has = sensor_law_of_lane(coefficients, 0), lane_traits(coefficients, 0, int(s.plays))
    driven = _commanded(p, s, command, current, position)
    advance_block(model, 1, 1, driven, tick, has, True, -1 - int(s.halvings))
    sampled_positions(1, state, coefficients)
    read = ROWS.spool_sampled if has.senses else ROWS.spool
    p[MONITOR.predicted], p[MONITOR.predicted + 1] = state[read], state[ROWS.pressure_sampled]
    p[MONITOR.predicted + 2] = state[ROWS.position_sampled]
    p[MONITOR.residual] = (spool - read_spool(sensor, state[read])) * s.spool_weight
    missed = pressure - read_pressure(sensor, state[ROWS.pressure_sampled])
    p[MONITOR.residual + 1] = missed * s.pressure_weight
    if math.isfinite(spool):
        anchor_spool_lanes(
            1, read, spool, s.anchor_gain, s.anchor_small, s.anchor_large, state, coefficients
        )
    return _accumulate(p, s, 0) + 4 * _accumulate(p, s, 1)


@kernel
def push_ticks(address: int, samples: Array2, modelled: Array2) -> None:
    """Advance model and sums by some ticks, see `push_tick`.

    samples: of each tick, shape (n, 5); modelled: gets spool (m), position (m) and current (A) of
    the model, and residuals of spool and pressure in deviations, shape (n, 5).
    """
    p = array_at(address, (MODEL.path,))
    for k in range(samples.shape[0]):
        row = samples[k]
        push_tick(address, (row[0], row[1], row[2], row[3], row[4]))
        modelled[k, 0] = p[MONITOR.predicted]
        modelled[k, 1] = p[MONITOR.predicted + 2]
        modelled[k, 2] = p[MODEL.state + ROWS.current]
        modelled[k, 3] = p[MONITOR.residual]
        modelled[k, 4] = p[MONITOR.residual + 1]
