"""Random units (actuators with faults and effects) and their simulated recordings.

A unit keeps its effects over its life (PHY-28 to 39); its faults, the oil and the noise are
those of a recording:

    unit = random_unit(np.random.default_rng(7), data=True)
    recording = record(unit, resolve_test("open"), Faults(0.2, 0.1, 0.4), seed=1)
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.model.plant import PlantConstants, plant_constants
from ehadiag.model.registry import FAULTS, Unknowns
from ehadiag_sim.conditions import DataErrors, Effects, Faults, Sensors, UnmodelledEffects
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S
from ehadiag_sim.simulation import simulate
from firmware_iface.recording import CHANNELS, Environment, Recording
from firmware_iface.stored_test import StoredTest

COARSE_STEP = 1e-6
"""Integration step of studies, s; four times as fast as the default, errors below the noise."""
GROUPS = ("sensing", "friction", "orifice", "strangers")
"""Of effects beside the data's errors, see `random_unit`."""


@dataclass(frozen=True, slots=True)
class Unit:
    """One actuator on a bench; effects and errors of its sensors are kept over its life."""

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
    by one play, backlash 0 to 5 µm. `data`: ten data-sheet values ±5 %. `sensing`: gains ±0.5 %,
    filter and sampling instant 0 to 0.2 ms, probes ±2 K and ±0.1 MPa. `friction`: Stribeck
    velocities 1 to 50 mm/s (evenly in the logarithm), hysteresis of 1 to 16 plays, load ±50 N.
    `orifice`: as second stage, oil of 6 to 9·10⁸ Pa. `strangers`: each effect that the
    identification does not know, by even chance. Each group has a stream of its own: switching one
    on does not change what the others draw. The generator is advanced by one `spawn`.
    """
    base, second, third, fourth, fifth, sixth = rng.spawn(6)
    actuator = actuator or default_actuator()
    effects = Effects(
        null_bias=_even(base, 0.02) * actuator.controller.IM,
        hysteresis=float(base.uniform(0.0, 0.04)),
        gain_change=_even(base, 0.05),
        backlash=float(base.uniform(0.0, 5e-6)),
    )
    a, b, c, d = (0.01 * 2048 * base.uniform(-1.0, 1.0, len(CHANNELS))).tolist()
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
        effects = replace(effects, plays=8, unmodelled=_random_strangers(sixth))
    return Unit(actuator, effects, sensors, serial)


def unit_with(
    rng: np.random.Generator, groups: Collection[str], serial: int, *, data: bool = True
) -> Unit:
    """Draw a unit with errors of its data, and groups of effects by name, see `random_unit`."""
    chosen = {name: name in groups for name in GROUPS}
    return random_unit(rng, None, data=data, serial=serial, **chosen)


def add_group(parser: argparse.ArgumentParser) -> None:
    """Add an option for groups of effects, see `random_unit`."""
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
    step: float = DEFAULT_STEP_S,
    oil_temperature: float | None = None,
    supply_pressure: float | None = None,
) -> Recording:
    """Record a stored test of a unit as an acquisition without a fault would deliver it.

    The step is the longest of the integration, s; oil temperature (degC) and supply pressure (Pa)
    are those of the unit's effects unless given.
    """
    effects = unit.effects
    if oil_temperature is not None:
        effects = replace(effects, oil_temperature=oil_temperature)
    if supply_pressure is not None:
        effects = replace(effects, supply_pressure=supply_pressure)
    done = simulate(unit.actuator, test, faults, effects, unit.sensors, seed=seed, step=step)
    return done.recording("simulated", unit.serial)


def damaged(
    constants: PlantConstants, severities: Sequence[float] | NDArray[np.float64]
) -> PlantConstants:
    """Constants of a unit, given those as new, with severities 0 … 1 in the order of `FAULTS`."""
    point = np.asarray(severities, dtype=np.float64)
    return Unknowns(FAULTS, (constants,), {}).constants(point)


def damaged_unit(
    severities: Sequence[float] | NDArray[np.float64],
    actuator: Actuator | None = None,
    environment: Environment | None = None,
) -> PlantConstants:
    """Constants of an actuator, the reference one unless given, with these severities."""
    return damaged(plant_constants(actuator or default_actuator(), environment), severities)


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
"""Largest sizes of the strangers in a random unit, each as its field of `UnmodelledEffects`."""


def _random_strangers(rng: np.random.Generator) -> UnmodelledEffects:
    drawn: dict[str, Any] = {}
    for name, size in STRANGE_SIZES.items():
        there, value = rng.random() < 0.5, _even(rng, size)
        if there:
            drawn[name] = abs(value) if name == "driver_lag" else value
    return UnmodelledEffects(**drawn)


def _even(rng: np.random.Generator, size: float) -> float:
    return float(rng.uniform(-size, size))


def _log_even(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
