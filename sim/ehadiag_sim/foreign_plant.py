"""Somebody else's plant in place of the simulated one: a co-simulation unit (FMU) run by FMPy."""

from __future__ import annotations

import math
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec

from ehadiag_sim.conditions import Effects, Faults, Sensors
from firmware_iface.errors import ConfigurationError, InputOutputError, install_command
from firmware_iface.files import read_toml


class PlantVariable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Variable of a plant; SI value = scale · value + offset."""

    variable: str
    scale: float = 1.0
    offset: float = 0.0


class PlantMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which variables of a plant are the actuator's signals and conditions."""

    current: PlantVariable | str = "current"
    """Input: servovalve current, A."""
    spool: PlantVariable | str = "spool"
    """Output: spool position, m."""
    pressure: PlantVariable | str = "pressure"
    """Output: differential pressure, Pa."""
    position: PlantVariable | str = "position"
    """Output: jack position, m."""
    conditions: dict[str, PlantVariable | str] = {}
    """Severities and effects of the simulator that the plant plays, by their names, SI."""
    start: dict[str, float] = {}
    """Values of other variables before the start, in the plant's units."""


OUTPUTS = ("spool", "pressure", "position")
PROBED = ("oil_temperature", "supply_pressure", "return_pressure")
"""Conditions that the computer's probes show also where the plant has no variable for them."""


def _variable(item: PlantVariable | str) -> PlantVariable:
    return PlantVariable(item) if isinstance(item, str) else item


class ForeignPlant:
    """A co-simulation unit that plays the actuator from servovalve current to sensors.

    A unit is a program of its maker: it runs with the rights of the caller. path: of the FMU (FMI
    2.0 or 3.0, with a binary for this computer); mapping: TOML file of a `PlantMapping`; None: the
    file of the FMU's name with the suffix .toml if there is one, else the names of the signals.
    ConfigurationError: FMPy is not installed; no such unit, or a mapping that does not fit it.
    """

    def __init__(self, path: Path, mapping: Path | None = None) -> None:
        if not path.is_file():
            raise ConfigurationError(f"plant {path}: is no file; name a unit (FMU)")
        try:
            import fmpy  # noqa: PLC0415 - an extra
        except ImportError:
            raise ConfigurationError(
                f"plant {path}: needs FMPy: {install_command('fmu')}"
            ) from None
        beside = path.with_suffix(".toml")
        source = mapping or (beside if beside.exists() else None)
        self.mapping = (
            PlantMapping() if source is None else read_toml(source, PlantMapping, "plant mapping")
        )
        self.where = f"plant {path}"
        self._folder = tempfile.mkdtemp(prefix="ehadiag-plant-")
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        try:
            self.description = fmpy.read_model_description(str(path))
            fmpy.extract(str(path), self._folder)
        except Exception as error:
            text = " ".join(str(error).split())
            raise ConfigurationError(f"{self.where}: no unit that FMPy reads: {text}") from None
        if not self.description.fmiVersion.startswith(("2", "3")):
            version = self.description.fmiVersion
            raise ConfigurationError(f"{self.where}: is of FMI {version}; need FMI 2.0 or 3.0")
        if self.description.coSimulation is None:
            raise ConfigurationError(f"{self.where}: not for co-simulation")
        real = ("Real", "Float64")
        self.references = {
            item.name: item.valueReference
            for item in self.description.modelVariables
            if item.type in real
        }
        signals = [_variable(getattr(self.mapping, name)) for name in ("current", *OUTPUTS)]
        conditions = [_variable(item) for item in self.mapping.conditions.values()]
        named = [item.variable for item in (*signals, *conditions)] + list(self.mapping.start)
        absent = [name for name in named if name not in self.references]
        if absent:
            raise ConfigurationError(
                f"{self.where}: no real variable {absent[0]!r}; name it in a mapping"
                f" ({source or beside})"
            )
        known = {
            item.name
            for kind in (Faults, Effects)
            for item in fields(kind)
            if "range" in item.metadata
        }
        for name in self.mapping.conditions:
            if name not in known:
                raise ConfigurationError(f"{source}: conditions: there is no {name!r}")
        for item in (*signals, *conditions):
            if item.scale == 0.0:
                raise ConfigurationError(f"{source}: {item.variable}: scale must not be 0")

    def begin(self, tick: float, faults: Faults, effects: Effects, sensors: Sensors) -> ForeignRun:
        """Return a run of the plant, from its own start.

        tick: s. ConfigurationError: a condition that the mapping does not name. InputOutputError:
        the unit fails.
        """
        if sensors.filter_time or sensors.early:
            raise ConfigurationError(f"{self.where}: takes no filter and no early sampling")
        return ForeignRun(self, self._folder, tick, faults, effects)

    def values(self, faults: Faults, effects: Effects) -> Mapping[str, float]:
        """Values of the plant's variables for severities and effects.

        ConfigurationError: one of them is not as new and has no variable.
        """
        found = {}
        for item, default in ((faults, Faults()), (effects, Effects())):
            for entry in fields(item):
                value = getattr(item, entry.name)
                target = self.mapping.conditions.get(entry.name)
                if target is not None:
                    place = _variable(target)
                    found[place.variable] = (float(value) - place.offset) / place.scale
                elif value == getattr(default, entry.name) or entry.name in PROBED:
                    continue
                elif "range" not in entry.metadata:
                    raise ConfigurationError(
                        f"{self.where}: effects of {entry.name} cannot be played by a foreign plant"
                    )
                else:
                    raise ConfigurationError(
                        f"{self.where}: no variable for {entry.name}: name one under [conditions]"
                    )
        return found


class ForeignRun:
    """One run of a foreign plant, tick by tick.

    plant: the unit; folder: where it is unpacked; tick: s; faults, effects: at the start.
    """

    def __init__(
        self, plant: ForeignPlant, folder: str, tick: float, faults: Faults, effects: Effects
    ) -> None:
        from fmpy.simulation import instantiate_fmu  # noqa: PLC0415 - an extra

        self._plant, self._tick, self._time = plant, tick, 0.0
        self._unit = self._called(
            instantiate_fmu, folder, plant.description, fmi_type="CoSimulation"
        )
        three = plant.description.fmiVersion.startswith("3")
        self._get = self._unit.getFloat64 if three else self._unit.getReal
        self._set = self._unit.setFloat64 if three else self._unit.setReal
        self._put(plant.mapping.start)
        self.change(faults, effects)
        if not three:
            self._called(self._unit.setupExperiment, startTime=0.0)
        self._called(self._unit.enterInitializationMode)
        self._called(self._unit.exitInitializationMode)
        self._current = _variable(plant.mapping.current)
        self._outputs = [_variable(getattr(plant.mapping, name)) for name in OUTPUTS]
        self._read(0.0)

    def change(self, faults: Faults, effects: Effects) -> None:
        """Take other severities and effects from now on."""
        self._put(self._plant.values(faults, effects))
        self.oil_temperature = effects.oil_temperature

    def advance(self, current: float) -> None:
        """Hold `current` (A) for one control tick."""
        place = self._current
        self._put({place.variable: (current - place.offset) / place.scale})
        self._called(self._unit.doStep, self._time, self._tick)
        self._time += self._tick
        self._read(current)

    def _read(self, current: float) -> None:
        references = [self._plant.references[item.variable] for item in self._outputs]
        raw = self._called(self._get, references)
        values = [
            item.scale * float(value) + item.offset
            for item, value in zip(self._outputs, raw, strict=True)
        ]
        if not all(map(math.isfinite, values)):
            raise InputOutputError(
                f"{self._plant.where}: an output is not finite at {self._time:.4g} s"
            )
        self.spool, self.pressure, self.position = values
        self.seen = (current, self.spool, self.pressure, self.position)

    def _put(self, values: Mapping[str, float]) -> None:
        references = [self._plant.references[name] for name in values]
        if references:
            self._called(self._set, references, list(values.values()))

    def _called(self, function: Any, *arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except Exception as error:
            text = " ".join(str(error).split())
            raise InputOutputError(f"{self._plant.where}: {text}") from None

    def close(self) -> None:
        """Free the unit; the run is over."""
        unit, self._unit = getattr(self, "_unit", None), None
        if unit is not None:
            unit.freeInstance()

    def __del__(self) -> None:
        self.close()
