"""One tick of the streaming monitor: the scalar model from a state carried between calls.

Spool, jack and control law are those of `ehadiag.model`; here stand what a lost sample does, and
the sums.
"""

from __future__ import annotations

import math

import numpy as np

from ehadiag.compile.jit import Array, Array2, brief_kernel, inlined, inlined_exact, kernel, merged
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.model.batch import anchored_spool
from ehadiag.model.laws import ControlLaw, ControlState, control_current
from ehadiag.model.scalar_spool import (
    SPOOL_GRID,
    SpoolTables,
    motor_tick,
    sampled_spool,
    spool_tick,
)
from ehadiag.model.second_stage import jack_tick
from ehadiag.model.sensors import read_pressure, read_spool
from ehadiag.model.spool_events import SpoolState
from ehadiag.monitor.monitor_memory import (
    MONITOR,
    CommandMemory,
    MonitorSettings,
    ValveMemory,
    command_of,
    control_law_of,
    control_of,
    drive_law_of,
    jack_law_of,
    jack_of,
    keep_command,
    keep_control,
    keep_jack,
    keep_valve,
    sensor_law_of,
    settings_of,
    spool_law_of,
    valve_of,
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


@merged
def _array_at_place(address: int, place: int, shape: tuple[int, ...]) -> Array:
    """What begins at a place of the layout; to cut it out of an array calls the runtime."""
    return array_at(address + BYTES_PER_NUMBER * place, shape)


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
    p = _array_at_place(address, 0, (MONITOR.end,))
    nodes = _array_at_place(address, MONITOR.nodes, (SPOOL_GRID.nodes, SPOOL_GRID.columns))
    s, law, m = settings_of(p), spool_law_of(p), valve_of(p)
    tables = SpoolTables(
        _array_at_place(address, MONITOR.slide, (SPOOL_GRID.finest_level + 1, 4, 4)),
        _array_at_place(address, MONITOR.loose, (SPOOL_GRID.finest_level + 1, 4, 4)),
        _array_at_place(address, MONITOR.ring, (SPOOL_GRID.finest_level + 1, 2, 2)),
        _array_at_place(address, MONITOR.decay, (SPOOL_GRID.finest_level + 1,)),
        law,
    )
    held = _array_at_place(address, MONITOR.plays, (int(s.plays) + 1,))
    deflection = motor_tick(drive_law_of(p), held, _commanded(p, s, command, current, position))
    before = SpoolState(m.xf, m.wf, m.xs, m.vs, m.wire, int(m.direction), m.clamped != 0.0)
    after, count = spool_tick(tables, deflection, control_law_of(p).tick, before, nodes, 0)
    sensor, tick = sensor_law_of(p), control_law_of(p).tick
    seen, lagged = sampled_spool(sensor, tick, nodes, 0, count, m.xs, m.lagged)
    innovation = spool - read_spool(sensor, seen)
    p12, jack, jack_spool = jack_tick(
        jack_law_of(p), sensor, tick, nodes, 0, count, jack_of(p), m.jack_spool
    )
    keep_jack(p, jack)
    p[MONITOR.predicted], p[MONITOR.predicted + 1] = seen, p12
    p[MONITOR.predicted + 2] = jack.place - sensor.lead * jack.velocity
    p[MONITOR.residual] = innovation * s.spool_weight
    missed = pressure - read_pressure(sensor, p12)
    p[MONITOR.residual + 1] = missed * s.pressure_weight
    xs, filtered, moved = anchored_spool(
        innovation, s.anchor_gain, s.anchor_small, s.anchor_large, after.xs, m.filtered, law.stroke
    )
    clamped = 1.0 if after.clamped else 0.0
    keep_valve(
        p,
        ValveMemory(
            after.xf,
            after.wf,
            xs,
            after.vs,
            after.wire + (xs - after.xs),
            float(after.direction),
            clamped,
            filtered,
            jack_spool + (xs - after.xs),
            lagged + (xs - after.xs),
            m.anchored + (1.0 if moved else 0.0),
        ),
    )
    return _accumulate(p, s, 0) + 4 * _accumulate(p, s, 1)


@kernel
def push_ticks(address: int, samples: Array2, modelled: Array2) -> None:
    """Advance model and sums by some ticks, see `push_tick`.

    samples: of each tick, shape (n, 5); modelled: gets spool (m), position (m) and current (A) of
    the model, and residuals of spool and pressure in deviations, shape (n, 5).
    """
    p = _array_at_place(address, 0, (MONITOR.end,))
    flowing = MONITOR.plays + int(settings_of(p).plays)
    for k in range(samples.shape[0]):
        row = samples[k]
        push_tick(address, (row[0], row[1], row[2], row[3], row[4]))
        modelled[k, 0] = p[MONITOR.predicted]
        modelled[k, 1] = p[MONITOR.predicted + 2]
        modelled[k, 2] = p[flowing]
        modelled[k, 3] = p[MONITOR.residual]
        modelled[k, 4] = p[MONITOR.residual + 1]
