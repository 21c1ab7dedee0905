"""Slow, readable reference of the plant: a stiff solver with event location and a mode automaton.

Written from model.md sections 1 to 3 alone; it shares no code with the kernels. Friction
and stops are modes; the instants of sticking, breaking away and striking a stop are roots that
scipy locates. Between them the equations are smooth but for the corners of the saturations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ehadiag.core.actuator import Actuator

__all__ = ["StiffReference"]

TOLERANCE = 1e-9
ABSOLUTE = np.array([1e-13, 1e-10] * 3)
"""m and m/s: a millionth of a converter's step and less."""
REVERSAL = 1e-9
"""m/s. A mass that creeps towards its equilibrium under dynamic friction never stops by the
equations; a root at zero would find the solver's rounding and let it stick."""

Vector = NDArray[np.float64]


@dataclass(slots=True)
class _Mass:
    """One coordinate: where it stands in the state, its friction, its stop, its mode."""

    x: int
    v: int
    inertia: float
    stop: float
    static: float
    dynamic: float
    motion: int = 0
    """+1 or -1: slides that way; 0: stands."""
    held: int = 0
    """+1 or -1: stands at that stop."""


@dataclass(frozen=True, slots=True)
class _Event:
    value: Callable[[Vector], float]
    direction: int
    action: Callable[[], None]


class StiffReference:
    """The plant from rest, tick by tick; state [XF, DXF, XS, DXS, XJ, DXJ].

    `slides` counts how often each of flapper, spool, jack began to move.
    """

    def __init__(
        self, actuator: Actuator, Kintas: float = 0.0, FSS: float = 0.0, FDJ: float = 0.0
    ) -> None:
        self._valve, self._jack = actuator.servovalve, actuator.jack
        valve, jack = self._valve, self._jack
        self._flow_gain = valve.GQF * (1.0 - 0.8 * Kintas)
        spool = valve.FSS0 + FSS * (valve.FSS1 - valve.FSS0)
        rod = jack.FDJ0 + FDJ * (jack.FDJ1 - jack.FDJ0)
        self._masses = (
            _Mass(0, 1, valve.JF, valve.XFM, 0.0, 0.0),
            _Mass(2, 3, valve.MS, valve.XSM, spool, spool / 2.0),
            _Mass(4, 5, jack.MJ, jack.XJM, 2.0 * rod, rod),
        )
        self._y = np.zeros(6)
        self._torque = 0.0
        self._period = 1.0 / actuator.controller.rate
        self.slides = [0, 0, 0]

    def respond(self, currents: Vector) -> Vector:
        """Spool (m), pressure (Pa), jack (m) at the end of each tick, shape (3, ticks).

        `currents` in A, one held for each tick, shape (ticks,).
        """
        return np.array([self._tick(current) for current in currents.tolist()]).T

    def _tick(self, current: float) -> tuple[float, float, float]:
        self._torque = self._valve.GM * current
        time = 0.0
        self._break_away()
        while time < self._period:
            table = list(self._events())
            solution = solve_ivp(
                self._rate,
                (time, self._period),
                self._y,
                method="LSODA",
                rtol=TOLERANCE,
                atol=ABSOLUTE,
                events=[_terminal(event) for event in table],
            )
            if not solution.success:
                raise RuntimeError(solution.message)
            time = float(solution.t[-1])
            self._y = solution.y[:, -1].copy()
            for times, event in zip(solution.t_events, table, strict=True):
                if len(times):
                    event.action()
            self._break_away()
        return float(self._y[2]), self._pressure(self._y), float(self._y[4])

    def _pressure(self, y: Vector) -> float:
        valve = self._valve
        if abs(valve.GP * y[2]) < valve.PSR:
            source, resistance = valve.GP * y[2], valve.GP / valve.GQ
        else:
            source, resistance = np.sign(y[2]) * valve.PSR, valve.PSR / (valve.GQ * abs(y[2]))
        # P12 = PS - R (AJ DXJ + CLK P12), solved for P12.
        pressure = (source - resistance * self._jack.AJ * y[5]) / (1.0 + resistance * valve.CLK)
        return float(np.clip(pressure, -valve.PSR, valve.PSR))

    def _act(self, index: int, y: Vector) -> float:
        """Sum of all forces on a mass but dry friction, N (flapper: torque, N m)."""
        valve, jack = self._valve, self._jack
        if index == 0:
            return float(self._torque - valve.KSF * y[2] - valve.KF * y[0] - valve.CF * y[1])
        if index == 1:
            flow = valve.AS * y[3]
            pressure = valve.GPF * y[0] - valve.GPF / self._flow_gain * flow
            return float(valve.AS * pressure - valve.CS * y[3])
        return float(jack.AJ * self._pressure(y) - jack.CJ * y[5] - jack.FR)

    def _rate(self, _time: float, y: Vector) -> list[float]:
        rate = [0.0] * 6
        for index, mass in enumerate(self._masses):
            if mass.motion:
                rate[mass.x] = y[mass.v]
                rate[mass.v] = (self._act(index, y) - mass.dynamic * mass.motion) / mass.inertia
        return rate

    def _break_away(self) -> None:
        """Let each mass that stands decide whether it moves now."""
        for index, mass in enumerate(self._masses):
            force = self._act(index, self._y)
            way = 1 if force > 0.0 else -1
            if mass.motion == 0 and abs(force) > mass.static and mass.held != way:
                self._start(index, way)

    def _events(self) -> Iterator[_Event]:
        for index, mass in enumerate(self._masses):
            if mass.motion == 0:
                for way in (1, -1):
                    if mass.held != way:
                        yield self._breaks_away(index, way)
            else:
                for way in (1, -1):
                    yield self._strikes(mass, way)
                if mass.static > 0.0:
                    yield self._comes_to_rest(mass)

    def _breaks_away(self, index: int, way: int) -> _Event:
        static = self._masses[index].static
        return _Event(
            lambda y: way * self._act(index, y) - static, 1, lambda: self._start(index, way)
        )

    def _strikes(self, mass: _Mass, way: int) -> _Event:
        def strike() -> None:
            self._stand(mass)
            mass.held = way
            self._y[mass.x] = way * mass.stop

        return _Event(lambda y: float(way * y[mass.x] - mass.stop), 1, strike)

    def _comes_to_rest(self, mass: _Mass) -> _Event:
        way = mass.motion
        return _Event(lambda y: float(way * y[mass.v] + REVERSAL), -1, lambda: self._stand(mass))

    def _start(self, index: int, way: int) -> None:
        self._masses[index].motion = way
        self._masses[index].held = 0
        self.slides[index] += 1

    def _stand(self, mass: _Mass) -> None:
        mass.motion = 0
        self._y[mass.v] = 0.0


def _terminal(event: _Event) -> Callable[[float, Vector], float]:
    """Wrap as scipy wants its events: a function with attributes."""

    class Function:
        terminal = True
        direction = event.direction

        def __call__(self, _time: float, y: Vector) -> float:
            return event.value(y)

    return Function()
