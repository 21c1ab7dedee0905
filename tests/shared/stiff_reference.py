"""Slow, readable reference of the plant: a stiff solver with event location.

Written from PHY-1 to 20 and PHY-28 to 39 alone; it shares no code with the kernels. Friction
and stops are modes; the instants of sticking, breaking away and striking a stop are roots that
scipy locates. Between them the equations are smooth but for the corners of the saturations and of
the play at the feedback ball.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import copysign, exp, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ehadiag.core.actuator import Actuator
from ehadiag_sim.conditions import Effects

__all__ = ["StiffReference"]

TOLERANCE = 1e-8
ABSOLUTE = np.array([1e-12, 1e-9] * 3 + [1e-1])
"""m, m/s and Pa. With it responses are a thousandth of a converter's step off at most."""
REVERSAL = 1e-9
"""m/s. A mass that creeps towards its equilibrium under dynamic friction never stops by the
equations; a root at zero would find the solver's rounding and let it stick."""

Vector = NDArray[np.float64]
State = list[float]
"""Plain numbers: numpy takes many times as long for one."""


@dataclass(slots=True)
class _Mass:
    """One coordinate: where it stands in the state, its friction, its stop, its mode."""

    x: int
    v: int
    inertia: float
    stop: float
    static: float
    dynamic: float
    stribeck: float = 0.0
    motion: int = 0
    """+1 or -1: slides that way; 0: stands."""
    held: int = 0
    """+1 or -1: stands at that stop."""

    def sliding(self, speed: float) -> float:
        """Friction at a speed, N."""
        if self.stribeck == 0.0:
            return self.dynamic
        return self.dynamic + (self.static - self.dynamic) * exp(-abs(speed) / self.stribeck)


def _clipped(value: float, least: float, most: float) -> float:
    return min(max(value, least), most)


@dataclass(frozen=True, slots=True)
class _Event:
    value: Callable[[State], float]
    direction: int
    action: Callable[[], None]


class StiffReference:
    """The plant from rest, tick by tick; state [XF, DXF, XS, DXS, XJ, DXJ, P12].

    Of the effects it knows null bias, hysteresis, gain, backlash, Stribeck friction and load; oil
    and supply are those of the actuator file. P12 is a state with orifices only. `slides` counts
    how often each of flapper, spool, jack began to move.
    """

    def __init__(
        self,
        actuator: Actuator,
        Kintas: float = 0.0,
        FSS: float = 0.0,
        FDJ: float = 0.0,
        effects: Effects | None = None,
    ) -> None:
        self._valve, self._jack = actuator.servovalve, actuator.jack
        self._stage, self._effects = actuator.second_stage, effects or Effects()
        self._rated = actuator.controller.IM
        valve, jack = self._valve, self._jack
        self._flow_gain = valve.GQF * (1.0 - 0.8 * Kintas)
        spool = valve.FSS0 + FSS * (valve.FSS1 - valve.FSS0)
        rod = jack.FDJ0 + FDJ * (jack.FDJ1 - jack.FDJ0)
        self._masses = (
            _Mass(0, 1, valve.JF, valve.XFM, 0.0, 0.0),
            _Mass(2, 3, valve.MS, valve.XSM, spool, spool / 2.0, self._effects.spool_stribeck),
            _Mass(4, 5, jack.MJ, jack.XJM, 2.0 * rod, rod, self._effects.jack_stribeck),
        )
        self._y: State = [0.0] * 7
        self._ball = 0.0
        self._plays = [0.0] * int(self._effects.plays)
        self._torque = 0.0
        self._period = 1.0 / actuator.controller.rate
        self.slides = [0, 0, 0]

    def respond(self, currents: Vector) -> Vector:
        """Spool (m), pressure (Pa), jack (m) at the end of each tick, shape (3, ticks).

        `currents` in A, one held for each tick, shape (ticks,).
        """
        return np.array([self._tick(current) for current in currents.tolist()]).T

    def _tick(self, current: float) -> tuple[float, float, float]:
        self._torque = self._valve.GM * (1.0 + self._effects.gain_change) * self._inside(current)
        time = 0.0
        self._break_away()
        while time < self._period:
            table = list(self._events())
            solution = solve_ivp(
                self._rate,
                (time, self._period),
                np.array(self._y),
                method="LSODA",
                rtol=TOLERANCE,
                atol=ABSOLUTE,
                events=[_terminal(event) for event in table],
            )
            if not solution.success:
                raise RuntimeError(solution.message)
            time = float(solution.t[-1])
            self._y = solution.y[:, -1].tolist()
            self._ball = self._feedback(self._y)
            for times, event in zip(solution.t_events, table, strict=True):
                if len(times):
                    event.action()
            self._break_away()
        return self._y[2], self._pressure(self._y), self._y[4]

    def _inside(self, current: float) -> float:
        """Current behind null bias and hysteresis, A."""
        effects, count = self._effects, len(self._plays)
        value = current + effects.null_bias
        for i, held in enumerate(self._plays):
            radius = effects.hysteresis * self._rated * (i + 0.5) / count
            self._plays[i] = _clipped(held, value - radius, value + radius)
        return sum(self._plays) / count

    def _feedback(self, y: State) -> float:
        """Where the ball is that KSF feels, m; the spool moves one way between two events."""
        play = self._effects.backlash
        return _clipped(self._ball, y[2] - play, y[2] + play)

    def _pressure(self, y: State) -> float:
        if self._stage.kind == "orifice":
            return y[6]
        valve = self._valve
        if abs(valve.GP * y[2]) < valve.PSR:
            source, resistance = valve.GP * y[2], valve.GP / valve.GQ
        else:
            source, resistance = copysign(valve.PSR, y[2]), valve.PSR / (valve.GQ * abs(y[2]))
        # P12 = PS - R (AJ DXJ + CLK P12), solved for P12.
        pressure = (source - resistance * self._jack.AJ * y[5]) / (1.0 + resistance * valve.CLK)
        return _clipped(pressure, -valve.PSR, valve.PSR)

    def _act(self, index: int, y: State) -> float:
        """Sum of all forces on a mass but dry friction, N (flapper: torque, N m)."""
        valve, jack = self._valve, self._jack
        if index == 0:
            return self._torque - valve.KSF * self._feedback(y) - valve.KF * y[0] - valve.CF * y[1]
        if index == 1:
            flow = valve.AS * y[3]
            pressure = valve.GPF * y[0] - valve.GPF / self._flow_gain * flow
            return valve.AS * pressure - valve.CS * y[3]
        return jack.AJ * self._pressure(y) - jack.CJ * y[5] - self._load(y)

    def _load(self, y: State) -> float:
        return self._jack.FR + self._effects.load + self._effects.load_spring * y[4]

    def _rises(self, y: State) -> float:
        """Rate of the pressure behind orifices, Pa/s."""
        valve = self._valve
        underlap = 2.0 * valve.PSR / valve.GP
        ahead, behind = 1.0 - y[6] / valve.PSR, 1.0 + y[6] / valve.PSR
        flow = valve.GQ * (
            max(y[2] + underlap, 0.0) * copysign(sqrt(abs(ahead)), ahead)
            - max(underlap - y[2], 0.0) * copysign(sqrt(abs(behind)), behind)
        )
        net = flow - self._jack.AJ * y[5] - valve.CLK * y[6]
        return 2.0 * self._stage.beta / self._stage.volume_of_one_chamber * net

    def _rate(self, _time: float, state: Vector) -> State:
        y, rate = state.tolist(), [0.0] * 7
        if self._stage.kind == "orifice":
            rate[6] = self._rises(y)
        for index, mass in enumerate(self._masses):
            if mass.motion:
                rate[mass.x] = y[mass.v]
                rate[mass.v] = self._acceleration(index, y)
        return rate

    def _acceleration(self, index: int, y: State) -> float:
        mass = self._masses[index]
        return (self._act(index, y) - mass.sliding(y[mass.v]) * mass.motion) / mass.inertia

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

        def __call__(self, _time: float, state: Vector) -> float:
            return event.value(state.tolist())

    return Function()
