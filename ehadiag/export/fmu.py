"""Co-simulation units (FMI 2.0 and 3.0) of the detailed simulator and of the streaming monitor."""

from __future__ import annotations

import hashlib
import io
import platform
import sys
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from ehadiag.compile.object_code import Function, Pointer, Processor, Table, object_code
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.false_alarms import HOURS_BETWEEN
from ehadiag.core.folder import Folder
from ehadiag.export.description import Variable, description
from ehadiag.export.library import MANIFEST, MONITOR, OWN_FUNCTIONS, manifest, template, write
from ehadiag.export.linking import c_compiler, link_shared
from ehadiag.model.plant import plant_constants
from ehadiag.monitor.cusum import design_cusum
from ehadiag.monitor.layout import PREDICTED, SIZE
from ehadiag.monitor.plan import monitor_plan
from ehadiag.monitor.prepare import Unit
from ehadiag_sim.plant.coefficients import Condition
from ehadiag_sim.plant.flat import (
    MEMORY,
    Inputs,
    Outputs,
    Settings,
    plant_plan,
    start_plant,
    tick_plant,
)

__all__ = ["VERSIONS", "actuator_variables", "export_fmus", "monitor_variables"]

VERSIONS: Final = ("2.0", "3.0")
C_LIBRARY: Final = frozenset({"log10", "pow", "exp10"})
"""What the simulator's oil may call: the same library that Python's arithmetic calls here."""
PLACES: Final = {
    ("linux", "x86_64"): ("linux64", "x86_64-linux"),
    ("linux", "aarch64"): ("aarch64-linux", "aarch64-linux"),
}
"""Folder of the binary in FMI 2.0 and 3.0."""
DATED: Final = (1980, 1, 1, 0, 0, 0)
"""Of all files in a unit, so that the same kernels give the same unit."""


@dataclass(frozen=True, slots=True)
class _Model:
    """What is packed into a unit.

    Attributes
    ----------
    name : str
        Of the unit, without the version.
    meaning : str
        For people.
    variables : tuple[Variable, ...]
        Parameters, inputs, outputs.
    functions : tuple[Function, ...]
        Of the object code.
    tables : Mapping[str, Sequence[float]]
        Its constants.
    memory : int
        Numbers that an instance keeps.
    hooks : str
        `eha_start` and `eha_tick_once`, in C.
    allowed : frozenset[str]
        What of the C library its code may call.
    """

    name: str
    meaning: str
    variables: tuple[Variable, ...]
    functions: tuple[Function, ...]
    tables: Mapping[str, Sequence[float]]
    memory: int
    hooks: str
    allowed: frozenset[str] = field(default_factory=frozenset)


def actuator_variables() -> tuple[Variable, ...]:
    """Variables of the simulator's unit; a name in `E_…` is an error of the actuator's data."""
    start = {"plays": 1.0, "oil_temperature": 40.0}
    start |= {"supply_pressure": 20.7e6, "return_pressure": 0.7e6}
    return (
        *_variables("parameter", (*Condition._fields, *Settings._fields), start),
        *_variables("input", Inputs._fields, {}),
        *_variables("output", Outputs._fields, {}),
    )


def monitor_variables(supply: float) -> tuple[Variable, ...]:
    """Variables of the monitor's unit; supply: minus return pressure, Pa."""
    inputs = ("command", "current", "spool", "pressure", "position")
    outputs = (
        "predicted_spool", "predicted_pressure", "predicted_position",
        "residual_spool", "residual_pressure",
        "spool_upper", "spool_lower", "pressure_upper", "pressure_lower", "alarms",
    )  # fmt: skip
    start = {"viscosity": 1.0, "supply": supply}
    return (
        *_variables("parameter", Unit._fields, start),
        *_variables("input", inputs, {}),
        *_variables("output", outputs, {}),
    )


def _variables(
    causality: str, names: Sequence[str], start: Mapping[str, float]
) -> tuple[Variable, ...]:
    return tuple(
        Variable(name, causality, start.get(name, 0.0), MEANINGS.get(name, name.replace("_", " ")))
        for name in names
    )


MEANINGS: Final = {
    "Kintas": "severity of the filter's clogging, 0 … 1",
    "FSS": "severity of the spool's friction, 0 … 1",
    "FDJ": "severity of the jack's friction, 0 … 1",
    "backlash": "half-width of the backlash at the feedback spring, m",
    "oil_temperature": "degC",
    "supply_pressure": "Pa",
    "return_pressure": "Pa",
    "spool_stribeck": "Stribeck velocity of the spool, m/s; 0: none",
    "jack_stribeck": "Stribeck velocity of the jack, m/s; 0: none",
    "load": "N",
    "load_spring": "N/m",
    "filter_time": "time constant before the converters of spool and pressure, s",
    "hysteresis": "of the torque motor, over rated current",
    "null_bias": "A",
    "closed": "not 0: commands are positions, m; else currents, A",
    "command": "A or m",
    "current": "A, digitised",
    "spool": "m, digitised",
    "pressure": "Pa, digitised",
    "position": "m, digitised",
    "true_current": "A",
    "true_spool": "m",
    "true_pressure": "Pa",
    "true_position": "m",
    "viscosity": "of the oil, over that at 40 degC",
    "supply": "supply minus return pressure, Pa",
    "spool_offset": "constant error of the spool's sensor, m",
    "pressure_offset": "constant error of the sensor of differential pressure, Pa",
    "alarms": "sum of 1 (spool, upper), 2 (lower), 4 (pressure, upper), 8 (lower)",
}


def export_fmus(actuator: Actuator, folder: Folder, *, hours: float = HOURS_BETWEEN) -> list[str]:
    """Write units of simulator and monitor, each for both versions of FMI, for this computer.

    Parameters
    ----------
    actuator : Actuator
        Whose data are in them as constants.
    folder : Folder
        Where to write; files of these names are replaced.
    hours : float
        Mean time between false alarms of the monitor, h.

    Returns
    -------
    list[str]
        Names of the files.

    Raises
    ------
    ConfigurationError
        No C compiler, or a computer for which FMI has no name here.
    InputOutputError
        The folder cannot be written, or the compiler fails.
    """
    compiler = c_compiler()
    if compiler is None:
        raise ConfigurationError("no C compiler (cc, or what CC names): a unit cannot be linked")
    places = PLACES.get((sys.platform, platform.machine()))
    if places is None:
        raise ConfigurationError(f"no units for {sys.platform} on {platform.machine()}")
    tick = 1.0 / actuator.controller.rate
    files: dict[str, bytes] = {}
    for model in (_simulator(actuator), _monitor(actuator, hours)):
        code = object_code(
            model.functions,
            model.tables,
            OWN_FUNCTIONS,
            Processor("", "host", shared=True),
            allowed=model.allowed,
        )
        for version, place in zip(VERSIONS, places, strict=True):
            name = f"{model.name}_fmi{version[0]}"
            token = hashlib.sha256(code + name.encode()).hexdigest()
            binary = link_shared(
                compiler,
                f"{name}.so",
                {
                    "fmu.c": template("fmu.c"),
                    "model.h": _header(model, name, token, tick),
                    "eha.o": code,
                },
            )
            text = description(version, name, token, tick, model.meaning, model.variables)
            files[f"{name}.fmu"] = _packed(
                {"modelDescription.xml": text, f"binaries/{place}/{name}.so": binary}
            )
    files[MANIFEST] = manifest(
        files, target="host", options={"actuator": actuator.name, "hours": hours}
    )
    write(folder, files)
    return list(files)


def _simulator(actuator: Actuator) -> _Model:
    of_both = (Pointer(), Table("eha_plant"), Pointer())
    return _Model(
        "eha_actuator",
        "Electrohydraulic actuator with faults and effects: command in, sensor signals out",
        actuator_variables(),
        (
            Function("eha_plant_start", start_plant, of_both),
            Function("eha_plant_tick", tick_plant, of_both),
        ),
        {"eha_plant": plant_plan(actuator)},
        MEMORY,
        template("fmu_actuator.h").decode(),
        C_LIBRARY,
    )


def _monitor(actuator: Actuator, hours: float) -> _Model:
    constants = plant_constants(actuator)
    plan = monitor_plan(actuator, constants, design_cusum(hours, 1.0 / actuator.controller.rate))
    return _Model(
        "eha_monitor",
        "Streaming monitor of an electrohydraulic actuator: residuals and their cumulative sums",
        monitor_variables(float(constants.PSR)),
        MONITOR,
        {"eha_plan": plan.tolist()},
        SIZE,
        template("fmu_monitor.h.in", predicted=str(PREDICTED)).decode(),
    )


def _header(model: _Model, name: str, token: str, tick: float) -> bytes:
    counts: dict[str, int] = {}
    for item in model.variables:
        counts[item.causality] = counts.get(item.causality, 0) + 1
    starts = ", ".join(repr(float(item.start)) for item in model.variables)
    lines: dict[str, Any] = {
        "MODEL": f'"{name}"',
        "TOKEN": f'"{token}"',
        "TICK": repr(tick),
        "VALUES": f"{len(model.variables)}u",
        "PARAMETERS": f"{counts['parameter']}u",
        "INPUTS": f"{counts['input']}u",
        "MEMORY": f"{model.memory}u",
        "STARTS": f"{{{starts}}}",
    }
    defined = "".join(f"#define EHA_{key} {value}\n" for key, value in lines.items())
    return (defined + model.hooks).encode()


def _packed(files: Mapping[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, DATED)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.endswith(".so") else 0o644) << 16
            archive.writestr(entry, data)
    return content.getvalue()
