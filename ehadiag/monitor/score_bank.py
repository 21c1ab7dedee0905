"""Bank of score tests: what a change of each parameter would do to the residuals of some ticks.

A block of ticks is pushed into a monitor and, from the same state, into one more for each
parameter, which is off by a step. The difference of the residuals is the parameter's sensitivity;
its products with the residuals and with other sensitivities are scores and information, which add
up over blocks (`ehadiag.monitor.change_test`). A residual counts by its sign alone where it is
large (P. J. Huber, Annals of Mathematical Statistics 35, 1964).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from ehadiag.compile.jit import Array, Array2
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.model.laws import jack_law
from ehadiag.model.plant import REFERENCE_TEMPERATURE
from ehadiag.model.registry import FAULT_NAMES, parameter
from ehadiag.monitor.plan import default_noise
from ehadiag.monitor.streaming import PAUSE_TICKS, Monitor, undecided_spool
from firmware_iface.recording import Channels, CommandMode, Environment


class BankParameter(NamedTuple):
    """What may change, in SI units: the step of its sensitivity, and what is no change."""

    name: str
    """By the registry, or `supply` and `oil`; `rest` is no cause, but where the spool stopped."""
    step: float
    """By which a monitor is off."""
    steady: float
    """Standard deviation of a unit that has not changed, for hours: repeatability of a diagnosis, a
    probe's tolerance."""
    passing: float = 0.0
    """The same from block to block: noise of the probes of oil and supply."""


BANK: Final = (
    BankParameter("Kintas", 0.1, 0.015),
    BankParameter("FSS", 0.05, 0.004),
    BankParameter("FDJ", 0.05, 0.004),
    BankParameter("spool_offset", 1e-6, 0.1e-6),
    BankParameter("pressure_offset", 0.1e6, 0.02e6),
    BankParameter("spool_gain", 0.02, 0.004),
    BankParameter("pressure_gain", 0.02, 0.005),
    BankParameter("position_gain", 0.02, 0.003),
    BankParameter("null_bias", 2e-5, 2e-6),
    BankParameter("load", 100.0, 30.0),
    BankParameter("supply", 0.3e6, 0.1e6, 0.1e6),
    BankParameter("oil", 3.0, 3.0, 1.0),
    BankParameter("rest", 0.25e-6, 0.0, 0.3e-6),
    BankParameter("current_offset", 1e-5, 2e-6),
    BankParameter("current_gain", 0.01, 0.002),
)
"""Sensors' repeatability is a tenth of a converter's step to half a step of 12 bits; the registry
has the meaning of names."""
BANK_NAMES: Final = tuple(item.name for item in BANK)
MODELLED: Final = BANK_NAMES.index("current_offset")
"""Number of parameters with a monitor of their own: the current's sensor needs none."""
REST: Final = BANK_NAMES.index("rest")
BLOCK_S: Final = 0.5
"""Length of a block, s."""
UNSTATED: Final = {"oil": 30.0, "supply": 2e6}
"""Standard deviation of oil (K) and supply (Pa) that the bus does not state."""
HUBER: Final = 3.0
"""Residual from which it counts by its sign alone, deviations: noise is below in 99.7 %."""
MAX_STEP_DEVIATIONS: Final = 5.0
"""Change of a residual by a step, deviations, from which the tick counts less: there a break-away
has moved, which is not in proportion to the parameter."""
TRAVEL_TICKS: Final = 50
"""Ticks over which the jack's travel is compared, 1: a tick's is below a converter's step."""
STATE_LSB: Final = 0.5
"""Uncertainty of the modelled spool that the pressure feels, converter steps: a rounding's."""
PASSING: Final = np.array([item.passing for item in BANK])
TRIAL_SETTLING: Final = 2
"""Blocks in which a monitor on trial settles, 1."""
MAX_SQUARE: Final = 25.0
"""Largest square of a residual that counts on trial: beyond five deviations all are alike."""
MIN_SUPPLY, MIN_OIL = 0.1e6, -60.0
"""Least supply (Pa) and oil temperature (degC) that are modelled: of the probes' ranges."""
CURRENT_LSB: Final = 0.58
"""Noise of the measured current, converter steps: half a step of noise and a rounding's."""
TRAVEL_LSB: Final = 0.82
"""Noise of a travel, converter steps: that of two positions."""


class BlockScore(msgspec.Struct, frozen=True, eq=False):
    """Score and information of a block, in steps of the bank."""

    score: Array
    """Shape (k,)."""
    information: Array2
    """Shape (k, k)."""
    gain: Array2
    """Squares of residuals that a step up or down explains beyond what is no change; each square of
    limited size. Shape (2, k)."""
    ticks: int


class ScoreBank:
    """Monitors of one unit, the first as it is given, each further one with a parameter off.

    actuator: data of the actuator; faults: severities as last identified; mode: what commands are;
    offsets: constant errors of spool (m) and pressure sensor (Pa); effects: nuisances by name, SI;
    channels: converters; None: those of the actuator's file. ConfigurationError: see `Monitor`.
    """

    def __init__(
        self,
        actuator: Actuator,
        faults: tuple[float, ...],
        *,
        mode: CommandMode = CommandMode.CURRENT,
        offsets: tuple[float, float] = (0.0, 0.0),
        effects: Mapping[str, float] | None = None,
        channels: Channels | None = None,
    ) -> None:
        channels = channels or actuator_channels(actuator)
        self.faults = faults
        """Severities as last identified, 1."""
        self._channels, self._rated = channels, actuator.controller.IM
        self._offset, self._undecided = offsets[0], undecided_spool(actuator, faults[2])
        self._noise = default_noise(channels)
        self._current_noise = CURRENT_LSB * channels.current.grain
        self.steps: Array = np.array([item.step for item in BANK])
        """Steps of the parameters; that of a severity near its limit is negative."""
        self.steps[: len(faults)] *= np.where(
            np.add(faults, self.steps[: len(faults)]) > 1.0, -1, 1
        )

        def monitor(name: str, step: float) -> Monitor:
            """Make a monitor with a parameter off by so much."""
            severities = [
                min(max(value + step * (item == name), 0.0), 1.0)
                for item, value in zip(FAULT_NAMES, faults, strict=True)
            ]
            errors = (
                offsets[0] + step * (name == "spool_offset"),
                offsets[1] + step * (name == "pressure_offset"),
            )
            changed = dict(effects or {})
            if name not in (*FAULT_NAMES, *UNSTATED, "", "rest", "spool_offset", "pressure_offset"):
                item = parameter(name)
                changed[name] = min(max(changed.get(name, 0.0) + step, item.lower), item.upper)
            return Monitor(
                actuator, severities, mode=mode, noise=self._noise, offsets=errors,
                effects=changed, channels=channels,
            )  # fmt: skip

        named = zip(BANK_NAMES, self.steps[:MODELLED].tolist(), strict=False)
        self._make, self._held = monitor, False
        self._monitors = [monitor("", 0.0), *(monitor(*item) for item in named)]
        self._gains = np.array([1.0 + item.constants.GXJ for item in self._monitors])
        self.tune(Environment())

    def tune(self, environment: Environment) -> None:
        """Take this oil and supply; of what is not stated those of the actuator's data hold."""
        constants = self._monitors[0].constants
        oil = environment.oil_temperature
        supply, drain = environment.supply_pressure, environment.return_pressure
        unstated = {"oil": oil is None, "supply": supply is None or drain is None}
        self.steady: Array = np.array(
            [UNSTATED[name] if unstated.get(name) else item.steady
             for name, item in zip(BANK_NAMES, BANK, strict=True)]
        ) / np.abs(self.steps)  # fmt: skip
        oil = REFERENCE_TEMPERATURE if oil is None else oil
        drop = constants.PSR if supply is None or drain is None else supply - drain
        self._jack = jack_law(constants._replace(PSR=drop))
        self._oil, self._drop = oil, drop
        for name, step, monitor in zip(
            ("", *BANK_NAMES), (0.0, *self.steps), self._monitors, strict=False
        ):
            self._tune(monitor, name, step)

    def _tune(self, monitor: Monitor, name: str, step: float) -> None:
        """Tune a monitor to oil and supply, one of which is off where it bears its name."""
        drop = max(self._drop + step * (name == "supply"), MIN_SUPPLY)
        monitor.tune(Environment(drop, 0.0, max(self._oil + step * (name == "oil"), MIN_OIL)))

    @property
    def mode(self) -> CommandMode:
        """What commands are."""
        return self._monitors[0].mode

    def follow(self, mode: CommandMode) -> None:
        """Take commands as of this mode from the next block on."""
        for monitor in self._monitors:
            monitor.follow(mode)

    def reset(self, spool: float) -> None:
        """Restart from rest with the spool measured there (m)."""
        self._monitors[0].reset(spool - self._offset)
        self._held = False

    def settle(self, rows: Array2) -> None:
        """Push a block of ticks, and put the modelled spool where it is seen."""
        self._put_where_seen(self._monitors[0], self._monitors[0].push_block(rows))

    def _put_where_seen(self, monitor: Monitor, modelled: Array2) -> None:
        errors = modelled[len(modelled) // 2 :, 3]
        errors = errors[np.isfinite(errors)]
        if len(errors):
            monitor.nudge(float(errors.mean()) * self._noise[0])

    def push(self, rows: Array2) -> BlockScore:
        """Take a block of ticks, rows as of `Monitor.push`, shape (n, 5)."""
        first = self._monitors[0]
        for monitor in self._monitors[1:]:
            monitor.adopt(first)
        self._monitors[1 + REST].nudge(BANK[REST].step)
        # A sensor that errs was there when the modelled spool was put where it is seen.
        spool = float(first.reading.predicted[0])
        for name, place in (("spool_offset", 1.0), ("spool_gain", spool)):
            index = BANK_NAMES.index(name)
            self._monitors[1 + index].nudge(-float(self.steps[index]) * place)
        modelled = np.stack([item.push_block(rows) for item in self._monitors])
        found = np.concatenate(self._residuals(rows, modelled, self._gains), axis=1)
        # What holds in one and not in the other counts once, not in each block of the hold.
        grain, seen = self._channels.spool.grain, rows[np.isfinite(rows[:, 2]), 2]
        rested, held = self._held, len(seen) and seen.std() < grain
        self._held = bool(held and np.ptp(modelled[0, :, 0]) < grain)
        if self._held:
            self._put_where_seen(first, modelled[0])
        residual, change = found[0], found[0] - found[1:]
        score, information = np.zeros(len(BANK)), np.zeros((len(BANK), len(BANK)))
        steps = np.maximum(np.abs(change).max(axis=0), MAX_STEP_DEVIATIONS)
        counted = slice(0, MODELLED)
        _add(score, information, counted, residual, change, (MAX_STEP_DEVIATIONS / steps) ** 2)
        current, flowing = rows[:, 1], modelled[0, :, 2]
        noise = self._current_noise
        fine = np.isfinite(current) & (np.abs(flowing) < self._rated - 3.0 * noise)
        flowing, current = flowing[fine], current[fine]
        change = np.stack((np.ones_like(flowing), flowing)) * self.steps[MODELLED:, None] / noise
        _add(score, information, slice(MODELLED, None), (current - flowing) / noise, change, 1.0)
        if rested and self._held:
            gain = np.zeros((2, len(BANK)))
        else:
            gain = self._gain(found, score, information)
        part = np.linalg.inv(np.eye(len(BANK)) + information * (PASSING / self.steps) ** 2)
        return BlockScore(part @ score, part @ information, gain, len(rows))

    def _gain(self, found: Array2, score: Array, information: Array2) -> Array2:
        """What a step of each parameter explains of a block, see `BlockScore`.

        Both with the step and without it all parameters take their likeliest values of what is no
        change.
        """
        residual, change = found[0], found[0] - found[1:]
        count, modelled = len(change), slice(0, MODELLED)
        allowed = np.hypot(self.steady, PASSING / self.steps)[modelled]
        inner = information[modelled, modelled]
        fit = np.linalg.inv(inner + np.diag(1.0 / np.maximum(allowed, 1e-9) ** 2))
        steps = np.concatenate((np.zeros((1, count)), np.eye(count), -np.eye(count)))
        taken = (score[modelled] - steps @ inner) @ fit
        left = residual - (steps + taken) @ change
        cost = np.minimum(left**2, MAX_SQUARE).sum(axis=1) + ((taken / allowed) ** 2).sum(axis=1)
        out = np.zeros((2, len(BANK)))
        shown = (change**2).sum(axis=-1) > 1.0
        out[:, modelled] = np.where(shown, (cost[0] - cost[1:]).reshape(2, count), 0.0)
        return out

    def gains(
        self, blocks: list[tuple[Array2, Environment]], trials: list[tuple[int, float]]
    ) -> Array2:
        """By how much causes explain blocks better, shape (trials, blocks after the settling).

        The scale of a model's errors in each channel of a block is not known: what is left of it
        counts by the logarithm of one and its mean square, as in Student's law, so that neither one
        bad block nor the channel with the most samples decides. blocks: ticks with oil and supply;
        trials: places in the bank and sizes in steps. The bank's own oil and supply are then those
        of the last block.
        """
        names = [("", 0.0)]
        names += [(BANK_NAMES[place], float(size * self.steps[place])) for place, size in trials]
        monitors = [
            self._make("" if name.startswith("current") else name, step) for name, step in names
        ]
        gains = 1.0 + np.array([item.constants.GXJ for item in monitors])
        offset, slope = (
            np.array([[step * (name == error)] for name, step in names])
            for error in ("current_offset", "current_gain")
        )
        mode, costs = self.mode, []
        for number, (rows, environment) in enumerate(blocks):
            self.tune(environment)
            for (name, step), monitor in zip(names, monitors, strict=True):
                self._tune(monitor, name, step)
                if number == 0:
                    monitor.follow(mode)
                    monitor.reset(float(np.nan_to_num(rows[0, 2])) - self._offset)
            modelled = np.stack([item.push_block(rows) for item in monitors])
            settling = number < TRIAL_SETTLING
            if settling or rows[:, 2].std() < self._channels.spool.grain:
                for monitor, block in zip(monitors, modelled, strict=True):
                    self._put_where_seen(monitor, block)
            if settling:
                continue
            fine = np.isfinite(rows[:, 1])
            current = rows[fine, 1] - modelled[0, fine, 2] * (1.0 + slope) - offset
            channels = *self._residuals(rows, modelled, gains), current / self._current_noise
            squares = [np.minimum(item**2, MAX_SQUARE) for item in channels]
            costs.append(
                sum(np.log1p(item.sum(axis=1) / max(item.shape[1], 1)) for item in squares)
            )
        found = np.array(costs).reshape(-1, len(names)).T
        return found[:1] - found[1:]

    def _residuals(self, rows: Array2, modelled: Array, gains: Array) -> list[Array2]:
        """Residuals of spool, pressure and travel by each monitor, deviations; those all have."""
        path, jack = modelled[0, :, 0], self._jack
        near = (np.abs(rows[:, 2] - self._offset) < self._undecided) | (
            np.abs(path) < self._undecided
        )
        rests = np.convolve(near, np.ones(PAUSE_TICKS + 1))[: len(rows)] > 0.0
        # The pressure feels the spool nearer to the middle all the more.
        felt = jack.flow / (jack.slope * np.maximum(np.abs(path), jack.corner) + jack.leak)
        spread = np.hypot(1.0, felt * STATE_LSB * self._channels.spool.grain / self._noise[1])
        pressure = np.where(rests, np.nan, modelled[:, :, 4] / spread)
        places = slice(None, None, TRAVEL_TICKS)
        travel = np.diff(rows[places, 4] - gains[:, None] * modelled[:, places, 1], axis=1)
        travel /= TRAVEL_LSB * self._channels.position.grain
        found = modelled[:, :, 3], pressure, travel
        return [item[:, np.isfinite(item).all(axis=0)] for item in found]


def _add(
    score: Array, information: Array2, places: slice, residual: Array, change: Array2, weight: Any
) -> None:
    weight = weight * np.minimum(1.0, HUBER / np.maximum(np.abs(residual), HUBER))
    score[places] = change @ (weight * residual)
    information[places, places] = (change * weight) @ change.T
