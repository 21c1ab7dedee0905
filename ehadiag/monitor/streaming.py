"""Streaming monitors: one sample a tick in, residuals and their cumulative sums out.

`Monitor` follows a test. `FreeMotionMonitor` follows a unit between tests too: it leaves out
the pressure while the spool is so near to its middle that less than a converter step of it decides
the pressure.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple, NoReturn, TypeVar, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2, Kernel
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.core.conversion import actuator_channels
from ehadiag.model.batch import Anchor
from ehadiag.model.laws import JACK_STATIC_FRICTION_RATIO
from ehadiag.model.plant import SLIP_TICKS, PlantConstants, relative_viscosity, slip_speed
from ehadiag.model.registry import FAULTS, REGISTRY, Unknowns, parameter, unit_constants
from ehadiag.model.simd_layout import ROWS, aligned_numbers
from ehadiag.monitor import monitor_memory
from ehadiag.monitor.monitor_memory import MonitorUnit, prepare_monitor, reset_monitor
from ehadiag.monitor.plan import CusumDesign, default_noise, design_cusum, monitor_plan
from ehadiag.monitor.push_kernel import push_tick, push_ticks
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import Channels, CommandMode, Environment

Scalar = TypeVar("Scalar", bound=np.generic)


TICK_RANGE_S = (1e-5, 0.1)
"""Range of the control tick, s."""
SPOOL_POSITION_PLACES = [
    monitor_memory.MODEL.state + row for row in (ROWS.spool, ROWS.wire, ROWS.spool_lagged)
]
"""Places that hold the spool's position (`ehadiag.monitor.push_kernel.push_tick`)."""
LOST_TICKS_PLACE = monitor_memory.MONITOR.command + monitor_memory.CommandMemory._fields.index(
    "lost"
)
STATE_PLACES = slice(monitor_memory.MONITOR.control, monitor_memory.MODEL.path)
"""Places of the state that goes on from tick to tick."""
VISCOSITY_PLACE, SUPPLY_PLACE, CLOSED_PLACE = (
    monitor_memory.SEVERITY_COUNT + MonitorUnit._fields.index(name)
    for name in ("viscosity", "supply", "closed")
)
ALARM_TABLE = np.array([[[n & 1, n & 2], [n & 4, n & 8]] for n in range(16)], dtype=np.bool_)
"""What `push_tick` returns, taken apart: rows spool and pressure, columns upper and lower sum."""


class Tick(NamedTuple):
    """What the bus says of one control tick; SI, NaN where lost or at the converter's end."""

    command: float
    """A or m, active during the tick."""
    current: float
    """A, as measured at the end of the tick, like the rest."""
    spool: float
    """m."""
    pressure: float
    """Pa."""
    position: float
    """m."""


class Reading(msgspec.Struct, frozen=True, eq=False):
    """Results of a push; the arrays are the monitor's own and change with the next push."""

    predicted: Array
    """Spool (m), pressure (Pa), position (m; from 0 at the start), shape (3,)."""
    residual: Array
    """Measured less modelled spool and pressure, in units of noise, shape (2,); NaN where the
    sample is lost."""
    cusum: Array
    """Upper and lower sum (columns) of spool and pressure (rows), in units of noise; a sum that
    raised an alarm is back at 0."""
    alarmed: NDArray[np.bool_]
    """Which sums raised an alarm at this tick, shape (2, 2)."""

    def copy(self) -> Reading:
        """Return a copy that further pushes do not change."""
        return Reading(
            self.predicted.copy(), self.residual.copy(), self.cusum.copy(), self.alarmed.copy()
        )


class Monitor:
    """Follows an actuator tick by tick.

    `push` takes constant memory and no lock of its own: call it from the thread that receives, and
    from one thread only. It is compiled when the monitor is made, never in `push`.

    Parameters
    ----------
    actuator : Actuator
        Data of the actuator.
    faults : Sequence[float] | Array
        Severities in the order of the registry, each 0 … 1, as last identified.
    environment : Environment | None
        Oil and supply; None: as the actuator's data say.
    mode : CommandMode
        Whether commands are currents or positions.
    hours : float
        Mean time between false alarms of the monitor as a whole, on white noise, h.
    shift : float
        Shift of the mean that the sums are designed to find soonest, in units of noise, 0.1 … 5.
    noise : tuple[float, float] | None
        Standard deviation of spool (m) and pressure (Pa), white; None: that of PHY-22 on the
        converters, of which finer ones than 12 bits count as 12 bits.
    offsets : tuple[float, float]
        Constant errors of spool (m) and pressure sensor (Pa).
    effects : Mapping[str, float] | None
        Nuisances and errors of data by the registry's names, as last identified, SI; None: none.
    anchor : Anchor | None
        How the modelled spool is kept on the measured one; None: by the converters' steps.
    channels : Channels | None
        Converters of the unit; None: those of its actuator file.

    Raises
    ------
    ConfigurationError
        A value out of its range.
    """

    def __init__(
        self,
        actuator: Actuator,
        faults: Sequence[float] | Array,
        environment: Environment | None = None,
        *,
        mode: CommandMode = CommandMode.CURRENT,
        hours: float = FALSE_ALARM_INTERVAL_H,
        shift: float = 1.0,
        noise: tuple[float, float] | None = None,
        offsets: tuple[float, float] = (0.0, 0.0),
        effects: Mapping[str, float] | None = None,
        anchor: Anchor | None = None,
        channels: Channels | None = None,
    ) -> None:
        law = actuator.controller
        tick = 1.0 / law.rate
        channels = channels or actuator_channels(actuator)
        noise = noise or default_noise(channels)
        values = _checked_severities(faults, noise, offsets, tick)
        base = unit_constants(actuator)
        constants = Unknowns((), (base,), _checked_effects(effects or {})).constants(np.empty(0))
        self.design: CusumDesign = design_cusum(hours, tick, shift)
        """Reference value and threshold of the sums."""
        self.constants: PlantConstants = constants
        """Constants of the unit as new with its effects, at the oil and supply of its data."""
        self.noise: tuple[float, float] = noise
        """Standard deviation of spool (m) and pressure (Pa)."""
        self._plan = monitor_plan(actuator, constants, self.design, noise, anchor, channels)
        closed = float(mode is CommandMode.POSITION)
        start = MonitorUnit(*offsets, 1.0, float(constants.PSR), closed)
        self._unit = np.array([*values, *start], dtype=np.float64)
        p = aligned_numbers(monitor_memory.MONITOR_SIZE)
        self._memory, self._address = p, p.ctypes.data
        self.tune(environment or Environment())
        self._push = cast("Kernel", push_tick).of_one_thread()
        self._alarms = 0
        self._alarmed = np.zeros((2, 2), dtype=np.bool_)
        self.reading: Reading = Reading(
            _view(p[monitor_memory.MONITOR.predicted : monitor_memory.MONITOR.residual]),
            _view(p[monitor_memory.MONITOR.residual : monitor_memory.MONITOR.cusum]),
            _view(p[monitor_memory.MONITOR.cusum : monitor_memory.MONITOR.model].reshape(2, 2)),
            _view(self._alarmed),
        )
        """Reading of the last push."""
        self.push(Tick(0.0, 0.0, 0.0, 0.0, 0.0))
        self.reset()

    def push(self, sample: tuple[float, float, float, float, float]) -> Reading:
        """Advance by one tick, a `Tick` or its five numbers; returns `reading`, always the same.

        Call it for every tick: a tick that did not arrive is `Tick` of five NaN. Types are not
        checked, which would cost time: whatever `float` converts is accepted, even a text.

        Parameters
        ----------
        sample : tuple[float, float, float, float, float]
            The tick: command, current, spool, pressure, position.

        Returns
        -------
        Reading
            The monitor's reading, always the same object.

        Raises
        ------
        TypeError
            The tick is not five numbers, or a `__float__` raised; the monitor is as it was.
        """
        try:
            alarms = self._push(self._address, *map(float, sample))
        except Exception:  # whatever a `__float__` raises
            raise TypeError(f"a tick is a tuple of five numbers, not {sample!r}") from None
        if alarms != self._alarms:
            self._alarms = alarms
            self._alarmed[:] = ALARM_TABLE[alarms]
        return self.reading

    def __reduce__(self) -> NoReturn:
        """Refuse to be copied: the copy would go on in the memory of this one."""
        raise TypeError("a monitor cannot be copied; make another one")

    @property
    def mode(self) -> CommandMode:
        """Whether commands are currents or positions."""
        closed = self._memory[monitor_memory.MONITOR_CLOSED] != 0.0
        return CommandMode.POSITION if closed else CommandMode.CURRENT

    def follow(self, mode: CommandMode) -> None:
        """Take commands in this mode from the next tick on; all else continues.

        The control law starts anew, as the flight-control computer's does.
        """
        closed = float(mode is CommandMode.POSITION)
        if self._memory[monitor_memory.MONITOR_CLOSED] == closed:
            return
        self._memory[monitor_memory.MONITOR_CLOSED] = self._unit[CLOSED_PLACE] = closed
        self._memory[monitor_memory.MONITOR.control : monitor_memory.MONITOR.command] = 0.0
        # The last command was of another kind: no slope leads on from it.
        self._memory[LOST_TICKS_PLACE] = 1.0

    def tune(self, environment: Environment) -> None:
        """Set oil and supply from the next tick on; all else continues.

        What the environment does not state is as the actuator's data say. A supply that is not
        above the return pressure raises ConfigurationError.
        """
        unit, oil = self._unit, environment.oil_temperature
        supply, drain = environment.supply_pressure, environment.return_pressure
        unit[VISCOSITY_PLACE] = 1.0 if oil is None else relative_viscosity(oil)
        unit[SUPPLY_PLACE] = (
            self.constants.PSR if supply is None or drain is None else supply - drain
        )
        state = self._memory[STATE_PLACES].copy()
        if prepare_monitor(self._address, self._plan.ctypes.data, unit.ctypes.data) != 0:
            raise ConfigurationError(f"supply pressure {unit[SUPPLY_PLACE]:g} Pa: need more than 0")
        self._memory[STATE_PLACES] = state

    def push_block(self, samples: Array2) -> Array2:
        """Advance by a block of ticks, each row as of `push`, as fast as the model can.

        Returns spool (m), position (m) and current (A) of the model, and residuals of spool and
        pressure in units of noise, shape (n, 5).
        """
        modelled = np.empty_like(samples)
        push_ticks(self._address, samples, modelled)
        return modelled

    def adopt(self, other: Monitor) -> None:
        """Go on from the state of another monitor of this unit."""
        self._memory[STATE_PLACES] = other._memory[STATE_PLACES]

    def nudge(self, spool: float) -> None:
        """Move the modelled spool by `spool` (m), as re-anchoring does, and restart the sums."""
        self._memory[SPOOL_POSITION_PLACES] += spool
        self._memory[monitor_memory.MONITOR.cusum : monitor_memory.MONITOR.model] = 0.0

    def reset(self, spool: float = 0.0) -> None:
        """Restart from rest with the spool at this position (m), as a stored test begins."""
        self._alarms, self._alarmed[:] = 0, False
        reset_monitor(self._address, spool)


def _checked_severities(
    faults: Sequence[float] | Array,
    noise: tuple[float, float],
    offsets: tuple[float, float],
    tick: float,
) -> tuple[float, ...]:
    values = tuple(float(value) for value in faults)
    if len(values) != len(FAULTS) or not all(0.0 <= value <= 1.0 for value in values):
        names = ", ".join(item.name for item in FAULTS)
        raise ConfigurationError(f"severities {values}: need {names}, each 0 … 1")
    if not all(0.0 < value < math.inf for value in noise):
        raise ConfigurationError(f"noise {noise}: need two positive numbers, m and Pa")
    if not all(math.isfinite(value) for value in offsets):
        raise ConfigurationError(f"offsets {offsets}: need two numbers, m and Pa")
    if not TICK_RANGE_S[0] <= tick <= TICK_RANGE_S[1]:
        raise ConfigurationError(f"controller.rate {1.0 / tick:g} Hz: need 10 … 1e5 Hz")
    return values


def _checked_effects(effects: Mapping[str, float]) -> dict[str, float]:
    """Effects as plain numbers, checked against the registry."""
    bounds = {item.name: (item.lower, item.upper) for item in REGISTRY if item not in FAULTS}
    for name, value in effects.items():
        if name not in bounds:
            raise ConfigurationError(f"effect {name!r}: none of the registry's")
        lower, upper = bounds[name]
        if not lower <= value <= upper:
            raise ConfigurationError(f"effect {name} {value:g}: need {lower:g} … {upper:g}")
    return {name: float(value) for name, value in effects.items()}


def _view(array: NDArray[Scalar]) -> NDArray[Scalar]:
    view = array.view()
    view.flags.writeable = False
    return view


UNDECIDED_SPOOL_STEPS = 3.0
"""Uncertainty of the modelled spool position, in converter steps."""
SETTLING_TICKS = 300
"""Ticks with a spool sample, after a reset or `settle`, from which on alarms count, 1."""
PAUSE_TICKS = 5
"""Ticks after the last undecided one that are left out too, 1: the jack may still stick."""


class FreeMotionMonitor:
    """Follows an actuator tick by tick, in tests and between them.

    monitor: the monitor that it pushes into, with the unit's own severities; undecided: spool
    position either side of the middle within which the pressure is undecided, m; see
    `undecided_spool`; offset: constant error of the spool's sensor, m; travel: of the jack in
    `SLIP_TICKS` ticks below which the pressure is undecided, too, m; see `undecided_travel`.
    """

    def __init__(
        self, monitor: Monitor, undecided: float, offset: float = 0.0, travel: float = 0.0
    ) -> None:
        self.monitor = monitor
        """The monitor that it pushes into."""
        self._undecided, self._offset, self._travel = undecided, offset, travel
        self._positions: deque[float] = deque(maxlen=SLIP_TICKS + 1)
        self._pause_left = 0
        self._settled_ticks = 0

    @property
    def settled(self) -> bool:
        """Whether the modelled spool has settled on the measured one: alarms count."""
        return self._settled_ticks >= SETTLING_TICKS

    def settle(self) -> None:
        """Let the modelled spool settle again from its present state; till then no alarm counts."""
        self._settled_ticks = 0

    def push(self, sample: tuple[float, float, float, float, float]) -> Reading:
        """Advance by one tick, see `Monitor.push`; an undecided pressure has the residual NaN."""
        command, current, spool, _, position = sample
        monitor, near = self.monitor, self._undecided
        if abs(spool - self._offset) < near or abs(monitor.reading.predicted[0]) < near:
            self._pause_left = PAUSE_TICKS
        if self._travel > 0.0:
            positions = self._positions
            positions.append(position)
            slides = abs(positions[-1] - positions[0]) >= self._travel  # not of a lost position
            if len(positions) <= SLIP_TICKS or not slides:
                self._pause_left = PAUSE_TICKS
        if self._pause_left:
            self._pause_left -= 1
            sample = command, current, spool, math.nan, position
        reading = monitor.push(sample)
        if self._settled_ticks < SETTLING_TICKS:
            residual = float(reading.residual[0])
            if math.isfinite(residual):
                self._settled_ticks += 1
                monitor.nudge(residual * monitor.noise[0] / (self._settled_ticks + 1))
        return reading

    def follow(self, mode: CommandMode) -> None:
        """Take commands in this mode from the next tick on, see `Monitor.follow`."""
        self.monitor.follow(mode)

    def reset(self, spool: float = 0.0) -> None:
        """Restart from rest with the spool at this position (m)."""
        self._pause_left, self._settled_ticks = PAUSE_TICKS, 0
        self._positions.clear()
        self.monitor.reset(spool)


def undecided_spool(actuator: Actuator, severity: float) -> float:
    """Distance of the spool from the middle within which it does not decide the pressure, m.

    The jack sticks where the pressure gain times the spool's position is less than its static
    friction, at a severity FDJ; the resolution of the converter is added.
    """
    constants: PlantConstants = unit_constants(actuator)
    step = actuator_channels(actuator).spool.grain
    worn = Unknowns((parameter("FDJ"),), (constants,), {}).constants(np.array([severity]))
    friction = JACK_STATIC_FRICTION_RATIO * float(worn.FDJ)
    return friction / (actuator.jack.AJ * actuator.servovalve.GP) + UNDECIDED_SPOOL_STEPS * step


def undecided_travel(actuator: Actuator, severity: float) -> float:
    """Travel of the jack in `SLIP_TICKS` ticks below which it slips in steps, m.

    severity: FDJ. 0 without oil in the second stage.
    """
    slip = slip_speed(unit_constants(actuator), severity)
    return slip * SLIP_TICKS / actuator.controller.rate
