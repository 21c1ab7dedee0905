"""Options of the simulated actuator, and the scenario file that holds whatever else it plays.

Both are made of the fields of the classes in `ehadiag_sim.conditions`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.cli.command_parser import closest_name
from ehadiag.cli.options import seed_number
from ehadiag_sim.conditions import (
    ConditionOption,
    DataErrors,
    Effects,
    Faults,
    Sensors,
    UnmodelledEffects,
    condition_options,
)
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import read_toml

if TYPE_CHECKING:
    from ehadiag_sim.control import SimulatorControl
    from ehadiag_sim.foreign_plant import ForeignPlant

DATA_ERROR_NAMES = tuple(item.name for item in fields(DataErrors))
OTHER_KEYS = ("data_error", "broken")
"""Keys of a scenario that are no fields of a class of conditions."""
CONDITIONS: tuple[type[Any], ...] = (Faults, Sensors, Effects, UnmodelledEffects)


def add_simulator_options(parser: argparse.ArgumentParser) -> None:
    """Add `--simulate`, severities, oil, supply, noise, seed and serial number."""
    group = parser.add_argument_group("simulated actuator")
    group.add_argument(
        "--simulate",
        nargs="?",
        const=True,
        metavar="FILE",
        help="simulate computer and actuator; FILE: a scenario (TOML) with effects, errors of"
        " sensors and broken hardware, which other options overrule",
    )
    for kind in (Faults, Sensors, Effects):
        for item in condition_options(kind):
            if kind is Faults:
                _add_condition(group, item, item.flag.lower())
            elif item.basic:
                _add_condition(group, item)
    group.add_argument(
        "--script",
        metavar="FILE",
        help="changes of the simulated unit while it runs, with their times (TOML)",
    )
    group.add_argument(
        "--plant",
        metavar="FMU",
        help="plant of another maker in place of the simulated actuator (FMI 2.0 or 3.0), a program"
        " that runs with your rights",
    )
    group.add_argument(
        "--plant-mapping",
        metavar="FILE",
        help="which variables of the plant are current, spool, pressure and position (TOML;"
        " default: the FMU's name with .toml)",
    )
    group.add_argument(
        "--simulator-seed",
        type=seed_number,
        default=1,
        metavar="N",
        help="seed of the simulated noise (default 1)",
    )
    group.add_argument(
        "--unit",
        type=int,
        default=1,
        metavar="N",
        help="serial number of the simulated unit (default 1)",
    )


def simulator_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the keyword arguments of `ehadiag_sim.emulator.emulated_computer`.

    Returns severities, effects, errors of sensors, broken hardware, seed, serial number, changes
    while it runs and another maker's plant. ConfigurationError: a value out of its range, a key
    that no scenario has. InputOutputError: scenario or script cannot be read.
    """
    scenario: Mapping[str, Any] = {}
    where = ""
    if isinstance(arguments.simulate, str):
        where = f"scenario {arguments.simulate}"
        scenario = read_toml(Path(arguments.simulate), dict[str, Any], "scenario")
        _refuse_unknown_keys(scenario, where)
    values = {kind: _condition_values(arguments, scenario, kind, where) for kind in CONDITIONS}
    return {
        "faults": Faults(**values[Faults]),
        "effects": Effects(
            **values[Effects],
            data=_data_errors(scenario.get("data_error", {}), where),
            unmodelled=UnmodelledEffects(**values[UnmodelledEffects]),
        ),
        "sensors": Sensors(**values[Sensors]),
        "broken": scenario.get("broken"),
        "seed": arguments.simulator_seed,
        "serial": arguments.unit,
        "control": _control(arguments),
        "foreign": _foreign_plant(arguments),
    }


def _foreign_plant(arguments: argparse.Namespace) -> ForeignPlant | None:
    mapping = arguments.plant_mapping
    if arguments.plant is None:
        if mapping is not None:
            raise ConfigurationError("--plant-mapping: goes with --plant FMU")
        return None
    from ehadiag_sim.foreign_plant import ForeignPlant  # noqa: PLC0415 - loads msgspec

    return ForeignPlant(Path(arguments.plant), Path(mapping) if mapping else None)


def _control(arguments: argparse.Namespace) -> SimulatorControl | None:
    """Return what changes the unit while it runs; None where neither option asks for it."""
    if arguments.script is None and getattr(arguments, "control", None) is None:
        return None
    from ehadiag_sim.control import SimulatorControl, read_script  # noqa: PLC0415 - loads numpy

    changes = read_script(arguments.script) if arguments.script else ()
    return SimulatorControl(changes, seed=arguments.simulator_seed)


def _refuse_unknown_keys(scenario: Mapping[str, Any], where: str) -> None:
    known = [item.key for kind in CONDITIONS for item in condition_options(kind)]
    known += OTHER_KEYS
    for name in scenario:
        if name not in known:
            near = closest_name(name, known)
            hint = f", did you mean {near}?" if near else ""
            raise ConfigurationError(f"{where}: there is no key {name}{hint}")


def _add_condition(group: argparse._ArgumentGroup, item: ConditionOption, *more: str) -> None:
    several = isinstance(item.default, tuple)
    group.add_argument(
        item.flag,
        *more,
        dest=item.field,
        type=int if isinstance(item.default, int) else float,
        nargs=len(item.default) if several else None,
        metavar=item.metavar,
        help=item.help.replace("%", "%%"),
    )


def _condition_values(
    arguments: argparse.Namespace, scenario: Mapping[str, Any], kind: type[Any], where: str
) -> dict[str, Any]:
    """Return values by field, SI: of the command line, else of the scenario, else the default."""
    values = {}
    for item in condition_options(kind):
        value: Any = getattr(arguments, item.field, None)
        if value is None:
            value = scenario.get(item.key, item.default)
            _refuse_other_kinds(value, item, where)
        value = tuple(value) if isinstance(value, list) else value
        number = isinstance(item.default, float)
        values[item.field] = float(value) * item.scale if number else value
    return values


def _refuse_other_kinds(value: Any, item: ConditionOption, where: str) -> None:
    """Raise ConfigurationError unless a value of a scenario is of its default's kind."""
    count = len(item.default) if isinstance(item.default, tuple) else None
    numbers = value if isinstance(value, list | tuple) else [value]
    sound = all(isinstance(number, int | float) and not isinstance(number, bool)
                for number in numbers)  # fmt: skip
    if isinstance(item.default, int):
        sound = sound and all(isinstance(number, int) for number in numbers)
    if not sound or isinstance(value, list | tuple) != (count is not None):
        raise ConfigurationError(f"{where}: {item.key}: {value!r} is no such number")
    if count is not None and len(numbers) != count:
        raise ConfigurationError(f"{where}: {item.key}: need {count} numbers")


def _data_errors(table: Any, where: str) -> DataErrors:
    """Return how far data are off the actuator file's, by a scenario's table."""
    if not isinstance(table, dict):
        raise ConfigurationError(f"{where}: data_error: need a table, such as {{ GM = 0.05 }}")
    for name, value in table.items():
        if name not in DATA_ERROR_NAMES or not isinstance(value, int | float):
            raise ConfigurationError(
                f"{where}: data_error: {name} = {value!r}: need a fraction of one of "
                f"{', '.join(DATA_ERROR_NAMES)}"
            )
    return DataErrors(**{name: float(value) for name, value in table.items()})
