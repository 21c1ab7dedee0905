"""The streaming monitor: one sample a tick in, residuals and their cumulative sums out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, NoReturn, TypeVar

import numpy as np
from numba import types
from numpy.typing import NDArray

from ehadiag.compile.address import entry_point
from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import Channels
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.false_alarms import HOURS_BETWEEN
from ehadiag.core.recording import CommandMode, Environment
from ehadiag.model.anchor import Anchor
from ehadiag.model.parameters import FAULTS, REGISTRY, Unknowns
from ehadiag.model.unit import unit_constants
from ehadiag.monitor import layout
from ehadiag.monitor.cusum import CusumDesign, design_cusum
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.plan import monitor_plan, usual_noise
from ehadiag.monitor.prepare import Unit, prepare, rest

__all__ = ["Monitor", "Reading", "Tick"]

Scalar = TypeVar("Scalar", bound=np.generic)


TICKS_S = (1e-5, 0.1)
CLOSED = layout.SETTINGS + layout.Settings._fields.index("closed")
NUDGED = [
    layout.MOVING + layout.Moving._fields.index(name)
    for name in ("xs", "wire", "jack_spool", "lagged")
]
"""All that has the spool's position (`ehadiag.monitor.kernel.push_tick`)."""
LOST = layout.FOLLOWED + layout.Followed._fields.index("lost")
ALARMS = np.array([[[n & 1, n & 2], [n & 4, n & 8]] for n in range(16)], dtype=np.bool_)
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


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What the monitor holds after a push; the arrays are its own and change with the next one.

    Attributes
    ----------
    predicted : NDArray[np.float64]
        Spool (m), pressure (Pa), position (m; from 0 at the start), shape (3,).
    residual : NDArray[np.float64]
        Measured less modelled spool and pressure, in units of noise, shape (2,); NaN where the
        sample is lost.
    cusum : NDArray[np.float64]
        Upper and lower sum (columns) of spool and pressure (rows), in units of noise; a sum
        that gave alarm is back at 0.
    alarmed : NDArray[np.bool_]
        Which sums gave alarm at this tick, shape (2, 2).
    """

    predicted: NDArray[np.float64]
    residual: NDArray[np.float64]
    cusum: NDArray[np.float64]
    alarmed: NDArray[np.bool_]

    def copy(self) -> Reading:
        """Return a reading that stays."""
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
    faults : Sequence[float] | NDArray[np.float64]
        Severities in the order of the registry (Kintas, FSS, FDJ), each 0 … 1, as last
        identified.
    environment : Environment | None
        Oil and supply; None: as the actuator's data say.
    mode : CommandMode
        What commands are.
    hours : float
        Mean time between false alarms of the monitor as a whole, on white noise, h.
    shift : float
        Of the mean, in units of noise, that the sums are to find soonest, 0.1 … 5.
    noise : tuple[float, float] | None
        Standard deviation of spool (m) and pressure (Pa), white; None: that of PHY-22 on the
        converters, finer ones than 12 bits counted as 12.
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
        faults: Sequence[float] | NDArray[np.float64],
        environment: Environment | None = None,
        *,
        mode: CommandMode = CommandMode.CURRENT,
        hours: float = HOURS_BETWEEN,
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
        noise = noise or usual_noise(channels)
        values = _checked(faults, noise, offsets, tick)
        base = unit_constants(actuator, environment)
        constants = Unknowns((), (base,), _known(effects or {})).constants(np.empty(0))
        self.design: CusumDesign = design_cusum(hours, tick, shift)
        """Reference value and threshold of the sums."""
        self.noise: tuple[float, float] = noise
        """Of spool (m) and pressure (Pa)."""
        plan = monitor_plan(actuator, constants, self.design, noise, anchor, channels)
        closed = float(mode is CommandMode.POSITION)
        start = Unit(*values, *offsets, 1.0, float(constants.PSR), closed)
        unit = np.array(start, dtype=np.float64)
        p = np.zeros(layout.SIZE)
        self._memory, self._address = p, p.ctypes.data
        if prepare(self._address, plan.ctypes.data, unit.ctypes.data) != 0:
            raise ConfigurationError(f"supply pressure {constants.PSR:g} Pa: need more than 0")
        self._push = entry_point(push_tick, types.intp, types.UniTuple(types.float64, 5))
        self._alarms = 0
        self._alarmed = np.zeros((2, 2), dtype=np.bool_)
        self.reading: Reading = Reading(
            _view(p[layout.PREDICTED : layout.RESIDUAL]),
            _view(p[layout.RESIDUAL : layout.CUSUM]),
            _view(p[layout.CUSUM : layout.PLAYS].reshape(2, 2)),
            _view(self._alarmed),
        )
        """What the last push left."""
        self.push(Tick(0.0, 0.0, 0.0, 0.0, 0.0))
        self.reset()

    def push(self, sample: tuple[float, float, float, float, float]) -> Reading:
        """Advance by one tick, a `Tick` or its five numbers; returns `reading`, always the same.

        Call it for every tick: a tick that did not arrive is `Tick` of five NaN. To look at types
        takes time that this call does not have: what `float` takes for a number, a text too, is
        taken.

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
            Not a tuple of five of these, or whatever a `__float__` raised; the monitor is as it
            was.
        """
        try:
            alarms = self._push(self._address, sample)
        except (TypeError, ValueError):
            raise TypeError(f"a tick is a tuple of five numbers, not {sample!r}") from None
        if alarms != self._alarms:
            self._alarms = alarms
            self._alarmed[:] = ALARMS[alarms]
        return self.reading

    def __reduce__(self) -> NoReturn:
        """Refuse to be copied: the copy would go on in the memory of this one."""
        raise TypeError("a monitor cannot be copied; make another one")

    def follow(self, mode: CommandMode) -> None:
        """Take commands as of this mode from the next tick on; all else goes on as it is.

        The control law begins anew, as the flight-control computer's does.

        Parameters
        ----------
        mode : CommandMode
            What the commands are now.
        """
        closed = float(mode is CommandMode.POSITION)
        if self._memory[CLOSED] == closed:
            return
        self._memory[CLOSED] = closed
        self._memory[layout.CONTROL : layout.FOLLOWED] = 0.0
        # The last command was of another kind: no slope leads on from it.
        self._memory[LOST] = 1.0

    def nudge(self, spool: float) -> None:
        """Move the modelled spool, as re-anchoring does, and begin the sums anew.

        Parameters
        ----------
        spool : float
            By how much, m.
        """
        self._memory[NUDGED] += spool
        self._memory[layout.CUSUM : layout.PLAYS] = 0.0

    def reset(self, spool: float = 0.0) -> None:
        """Begin anew, from rest with the spool there (m), as a stored test begins."""
        self._alarms, self._alarmed[:] = 0, False
        rest(self._address, spool)


def _checked(
    faults: Sequence[float] | NDArray[np.float64],
    noise: tuple[float, float],
    offsets: tuple[float, float],
    tick: float,
) -> tuple[float, float, float]:
    values = tuple(float(value) for value in faults)
    if len(values) != len(FAULTS) or not all(0.0 <= value <= 1.0 for value in values):
        names = ", ".join(item.name for item in FAULTS)
        raise ConfigurationError(f"severities {values}: need {names}, each 0 … 1")
    if not all(0.0 < value < math.inf for value in noise):
        raise ConfigurationError(f"noise {noise}: need two positive numbers, m and Pa")
    if not all(math.isfinite(value) for value in offsets):
        raise ConfigurationError(f"offsets {offsets}: need two numbers, m and Pa")
    if not TICKS_S[0] <= tick <= TICKS_S[1]:
        raise ConfigurationError(f"controller.rate {1.0 / tick:g} Hz: need 10 … 1e5 Hz")
    return values[0], values[1], values[2]


def _known(effects: Mapping[str, float]) -> dict[str, float]:
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
