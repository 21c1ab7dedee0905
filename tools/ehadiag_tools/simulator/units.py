"""Random units (actuators with faults and effects) and their simulated recordings.

A unit keeps its effects over its life (PHY-28 to 39); its faults, the oil and the noise are
those of a recording:

    unit = random_unit(np.random.default_rng(7), data=True)
    recording = record(unit, resolve_test("open"), Faults(0.2, 0.1, 0.4), seed=1)
"""

from __future__ import annotations

import argparse
from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace

import msgspec
import numpy as np

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag_sim.plant.conditions import DataErrors, Effects, Faults, Sensors, Strangers
from ehadiag_sim.plant.dynamics import DEFAULT_STEP
from ehadiag_sim.plant.simulator import simulate

__all__ = ["COARSE_STEP", "GROUPS", "Unit", "add_group", "random_unit", "record", "unit_with"]

COARSE_STEP = 1e-6
"""Four times as fast as the default; its error beside the noise: docs, detailed-model.md."""
GROUPS = ("sensing", "friction", "orifice", "strangers")
"""Of effects beside the data's errors, see `random_unit`."""
HALF_RANGE_CODES = 2048
RATED_BIAS = 0.02
"""Of rated current."""


@dataclass(frozen=True, slots=True)
class Unit:
    """One actuator on a bench.

    Attributes
    ----------
    actuator: the data that the simulator has, the class of its second stage among them.
    effects: what the unit keeps over its life.
    sensors: how its converters and probes err.
    serial: number on its plate.
    """

    actuator: Actuator = field(default_factory=default_actuator)
    effects: Effects = field(default_factory=Effects)
    sensors: Sensors = field(default_factory=Sensors)
    serial: int | None = None


def random_unit(
    rng: np.random.Generator,
    actuator: Actuator | None = None,
    *,
    data: bool = False,
    sensing: bool = False,
    friction: bool = False,
    orifice: bool = False,
    strangers: bool = False,
    serial: int | None = None,
) -> Unit:
    """Draw a unit, each effect evenly within its usual size (PHY-28 to 39).

    Always: offsets ±1 % of range, gain ±5 %, null bias ±2 % of rated current, hysteresis 0 to 4 %
    by one play, backlash 0 to 5 µm. Each group has a stream of its own: switching one on does not
    change what the others draw.

    Parameters
    ----------
    rng: is advanced by one `spawn`.
    actuator: data to begin with; default the reference actuator.
    data: ten data-sheet values ±5 %.
    sensing: gains ±0.5 %, filter and sampling instant 0 to 0.2 ms, probes ±2 K and ±0.1 MPa.
    friction: Stribeck velocities 1 to 50 mm/s (evenly in the logarithm), hysteresis of 1 to 16
        plays, load ±50 N.
    orifice: the second stage has orifices, its oil 6 to 9·10⁸ Pa.
    strangers: each effect that the identification does not know, by even chance; see `Strangers`.
    serial: number on the unit's plate.
    """
    base, second, third, fourth, fifth, sixth = rng.spawn(6)
    actuator = actuator or default_actuator()
    effects = Effects(
        null_bias=_even(base, RATED_BIAS) * actuator.controller.IM,
        hysteresis=float(base.uniform(0.0, 0.04)),
        gain_change=_even(base, 0.05),
        backlash=float(base.uniform(0.0, 5e-6)),
    )
    a, b, c, d = (0.01 * HALF_RANGE_CODES * base.uniform(-1.0, 1.0, len(CHANNELS))).tolist()
    sensors = Sensors(offsets_lsb=(a, b, c, d))
    if data:
        errors = {item.name: _even(second, 0.05) for item in fields(DataErrors)}
        effects = replace(effects, data=DataErrors(**errors))
    if sensing:
        sensors = replace(
            sensors,
            gains=(0.0, _even(third, 0.005), _even(third, 0.005), _even(third, 0.005)),
            filter_time=float(third.uniform(0.0, 0.2e-3)),
            early=float(third.uniform(0.0, 0.2e-3)),
            temperature_error=_even(third, 2.0),
            supply_error=_even(third, 0.1e6),
        )
    if friction:
        effects = replace(
            effects,
            spool_stribeck=_log_even(fourth, 1e-3, 50e-3),
            jack_stribeck=_log_even(fourth, 1e-3, 50e-3),
            plays=int(fourth.integers(1, 17)),
            load=_even(fourth, 50.0),
        )
    if orifice:
        stage = msgspec.structs.replace(
            actuator.second_stage, kind="orifice", beta=float(fifth.uniform(6e8, 9e8))
        )
        actuator = msgspec.structs.replace(actuator, second_stage=stage)
    if strangers:
        effects = replace(effects, plays=8, strangers=_random_strangers(sixth))
    return Unit(actuator, effects, sensors, serial)


def unit_with(rng: np.random.Generator, groups: Collection[str], serial: int) -> Unit:
    """Draw a unit with errors of its data and groups of effects by name, see `random_unit`."""
    return random_unit(
        rng,
        data=True,
        sensing="sensing" in groups,
        friction="friction" in groups,
        orifice="orifice" in groups,
        strangers="strangers" in groups,
        serial=serial,
    )


def add_group(parser: argparse.ArgumentParser) -> None:
    """Let a tool's command line ask for groups of effects, see `random_unit`."""
    parser.add_argument(
        "--group",
        action="append",
        default=[],
        choices=GROUPS,
        help="further effects of the units; may be repeated (none)",
    )


def record(
    unit: Unit,
    test: StoredTest,
    faults: Faults | None = None,
    *,
    seed: int = 0,
    step: float = DEFAULT_STEP,
    oil_temperature: float | None = None,
    supply_pressure: float | None = None,
) -> Recording:
    """Record a stored test of a unit as an acquisition without a fault would deliver it.

    Parameters
    ----------
    unit, test, faults: what runs.
    seed: of the noise.
    step: longest integration step, s.
    oil_temperature: degC, of this recording; default that of the unit's effects.
    supply_pressure: Pa, of this recording; default that of the unit's effects.

    Raises
    ------
    ConfigurationError: a value out of range; test and controller at different rates.
    """
    effects = unit.effects
    if oil_temperature is not None:
        effects = replace(effects, oil_temperature=oil_temperature)
    if supply_pressure is not None:
        effects = replace(effects, supply_pressure=supply_pressure)
    done = simulate(unit.actuator, test, faults, effects, unit.sensors, seed=seed, step=step)
    return done.recording("simulated", unit.serial)


STRANGE_SIZES = {
    "torque_cubic": 0.05,
    "play_skew": 3.0,
    "driver_lag": 0.3e-3,
    "land_asymmetry": 0.03,
    "land_shift": 2e-6,
    "spool_bend_2": 0.005,
    "spool_bend_3": 0.01,
    "jack_bend_2": 0.005,
    "jack_bend_3": 0.01,
    "oil_drift": 1.0,
    "friction_asymmetry": 0.05,
    "spool_friction_slope": 0.05,
}
"""Largest size of each stranger in a random unit."""


def _random_strangers(rng: np.random.Generator) -> Strangers:
    drawn = {}
    for name, size in STRANGE_SIZES.items():
        there, value = rng.random() < 0.5, _even(rng, size)
        if there:
            drawn[name] = abs(value) if name == "driver_lag" else value
    return Strangers(**drawn)


def _even(rng: np.random.Generator, size: float) -> float:
    return float(rng.uniform(-size, size))


def _log_even(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
