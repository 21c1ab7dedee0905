"""Exports co-simulation units (FMI 2.0 and 3.0) of the simulator and of the monitor."""

from __future__ import annotations

import hashlib
import io
import platform
import sys
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from ehadiag.compile.elementary import C_FUNCTIONS, ROUNDING_FUNCTIONS
from ehadiag.compile.libraries import object_files
from ehadiag.compile.worker import (
    CFunction,
    DoublesArgument,
    ObjectFile,
    PointerArgument,
    TableArgument,
)
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H, __version__
from ehadiag.export.library import (
    MANIFEST_FILE,
    fill_template,
    make_manifest,
    write_files,
)
from ehadiag.export.targets import HOST, c_compiler, cross_compiler, link_shared
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import FAULTS, REGISTRY
from ehadiag.monitor.monitor_memory import (
    MONITOR,
    MONITOR_SIZE,
    MONITOR_UNIT_FIELDS,
    prepare_monitor,
)
from ehadiag.monitor.plan import design_cusum, monitor_plan
from ehadiag.monitor.push_kernel import push_tick
from ehadiag_sim.fmu_plant import (
    FIXED_VALUES,
    PLANT_MEMORY,
    FmuInputs,
    FmuOutputs,
    FmuSettings,
    plant_plan,
    start_plant,
    tick_plant,
)
from ehadiag_sim.plant_laws import UnitCondition
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import Folder


class FmuVariable(msgspec.Struct, frozen=True):
    """A number that a unit shows to its master."""

    name: str
    causality: str
    """"parameter", "input" or "output"."""
    start: float
    """Before anything is set."""
    meaning: str
    """For people."""
    unit: str
    """Unit of measure, one of `FMU_UNITS`."""
    is_fixed: bool = False
    """Whether a parameter cannot be set in a run."""


FMU_UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "1": {},
    "A": {"A": 1},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m³": {"m": 3},
    "s": {"s": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N/m": {"kg": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "degC": {"K": 1, "offset": 273.15},
}
"""Units of measure by their exponents of SI base units (FMI 2.0, 2.2.2)."""


def model_description(
    version: str,
    model: str,
    token: str,
    tick: float,
    meaning: str,
    variables: Sequence[FmuVariable],
) -> bytes:
    """Describe a unit whose variables have their places as value references.

    version: "2.0" or "3.0"; model: identifier, the name of the shared library; token: that a master
    must show to make an instance; tick: s, the internal step; meaning: one line for people;
    variables: parameters, then inputs, then outputs. Returns XML.
    """
    three = version == "3.0"
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": model,
            "instantiationToken" if three else "guid": token,
            "description": meaning,
            "generationTool": f"ehadiag {__version__}",
            "variableNamingConvention": "flat",
        },
    )
    word = "State" if three else "state"
    co = {"modelIdentifier": model, "canHandleVariableCommunicationStepSize": "true"}
    co |= {f"canGetAndSetFMU{word}": "true", f"canSerializeFMU{word}": "true"}
    if three:
        co["fixedInternalStepSize"] = repr(tick)
    ET.SubElement(root, "CoSimulation", co)
    used = ET.SubElement(root, "UnitDefinitions")
    for unit in sorted({item.unit for item in variables}):
        exponents = {key: f"{value:g}" for key, value in FMU_UNITS[unit].items()}
        ET.SubElement(ET.SubElement(used, "Unit", {"name": unit}), "BaseUnit", exponents)
    ET.SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": repr(tick)})
    listed = ET.SubElement(root, "ModelVariables")
    if three:
        ET.SubElement(
            listed,
            "Float64",
            {
                "name": "time",
                "valueReference": str(len(variables)),
                "causality": "independent",
                "variability": "continuous",
            },
        )
    for place, item in enumerate(variables):
        attributes = {
            "name": item.name,
            "valueReference": str(place),
            "causality": item.causality,
            "variability": "discrete",
            "description": item.meaning,
        }
        if item.causality == "parameter":
            attributes["variability"] = "fixed" if item.is_fixed else "tunable"
        start = {"start": repr(float(item.start)), "unit": item.unit}
        if item.causality == "output":
            attributes["initial"] = "exact"
        if three:
            ET.SubElement(listed, "Float64", {**attributes, **start})
        else:
            ET.SubElement(ET.SubElement(listed, "ScalarVariable", attributes), "Real", start)
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [n for n, item in enumerate(variables) if item.causality == "output"]
    if three:
        for place in outputs:
            ET.SubElement(structure, "Output", {"valueReference": str(place)})
    else:
        group = ET.SubElement(structure, "Outputs")
        for place in outputs:
            ET.SubElement(group, "Unknown", {"index": str(place + 1)})
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


FMI_VERSIONS: Final = ("2.0", "3.0")
C_LIBRARY_FUNCTIONS: Final = frozenset({"log10", "pow", "exp10"})
"""What the simulator's oil may call: the same library that Python's arithmetic calls here."""


class FmuPlatform(msgspec.Struct, frozen=True):
    """A computer for which a unit can carry a binary."""

    triple: str
    """In LLVM's names."""
    zig: str
    """In Zig's, with the oldest C library or system on which the binary runs."""
    folder: str
    """Of the binary in FMI 2.0."""
    suffix: str
    """Of a shared library."""


FMU_PLATFORMS: Final[Mapping[str, FmuPlatform]] = {
    "x86_64-linux": FmuPlatform(
        "x86_64-unknown-linux-gnu", "x86_64-linux-gnu.2.17", "linux64", ".so"
    ),
    # FMI 2.0 has no names of its own for AArch64: 2.0.5 takes those of 3.0.
    "aarch64-linux": FmuPlatform(
        "aarch64-unknown-linux-gnu", "aarch64-linux-gnu.2.17", "aarch64-linux", ".so"
    ),
    "x86_64-windows": FmuPlatform("x86_64-pc-windows-gnu", "x86_64-windows-gnu", "win64", ".dll"),
    "x86_64-darwin": FmuPlatform(
        "x86_64-apple-macosx11", "x86_64-macos.11.0", "darwin64", ".dylib"
    ),
    "aarch64-darwin": FmuPlatform(
        "arm64-apple-macosx11", "aarch64-macos.11.0", "aarch64-darwin", ".dylib"
    ),
}
"""By the names of FMI 3.0, which are also the binaries' folders in it."""


class _FmuModel(msgspec.Struct, frozen=True):
    """What is packed into a unit."""

    name: str
    """Of the unit, without the version."""
    meaning: str
    """For people."""
    variables: tuple[FmuVariable, ...]
    """Parameters, inputs, outputs."""
    functions: tuple[CFunction, ...]
    """Of the object code."""
    tables: Mapping[str, Sequence[float]]
    memory: int
    """Numbers that an instance keeps."""
    hooks: str
    """`eha_start` and `eha_tick_once`, in C."""
    allowed: frozenset[str] = msgspec.field(default_factory=frozenset)
    """What of the C library its code may call."""


def actuator_variables() -> tuple[FmuVariable, ...]:
    """Variables of the simulator's unit; a name in `E_…` is an error of the actuator's data."""
    start = {"plays": 1.0, "oil_temperature": 40.0}
    start |= {"supply_pressure": 20.7e6, "return_pressure": 0.7e6}
    return (
        *_variables(
            "parameter", (*UnitCondition._fields, *FmuSettings._fields), start, FIXED_VALUES
        ),
        *_variables("input", FmuInputs._fields),
        *_variables("output", FmuOutputs._fields),
    )


def monitor_variables(supply: float) -> tuple[FmuVariable, ...]:
    """Variables of the monitor's unit; supply: supply minus return pressure, Pa."""
    inputs = ("command", "current", "spool", "pressure", "position")
    outputs = (
        "predicted_spool", "predicted_pressure", "predicted_position",
        "residual_spool", "residual_pressure",
        "spool_upper", "spool_lower", "pressure_upper", "pressure_lower", "alarms",
    )  # fmt: skip
    start = {"viscosity": 1.0, "supply": supply}
    return (
        *_variables("parameter", MONITOR_UNIT_FIELDS, start, MONITOR_UNIT_FIELDS),
        *_variables("input", inputs),
        *_variables("output", outputs),
    )


def _variables(
    causality: str,
    names: Sequence[str],
    start: Mapping[str, float] | None = None,
    fixed: Collection[str] = (),
) -> tuple[FmuVariable, ...]:
    made = []
    for name in names:
        unit, meaning = VARIABLE_MEANINGS.get(name, ("1", name.replace("_", " ")))
        made.append(
            FmuVariable(name, causality, (start or {}).get(name, 0.0), meaning, unit, name in fixed)
        )
    return tuple(made)


VARIABLE_MEANINGS: Final[Mapping[str, tuple[str, str]]] = {
    **{item.condition or item.name: (item.unit, item.meaning) for item in REGISTRY},
    **{item.name: ("1", f"severity, 0 … 1: {item.meaning}") for item in FAULTS},
    "oil_temperature": ("degC", "temperature of the oil"),
    "supply_pressure": ("Pa", "supply pressure"),
    "return_pressure": ("Pa", "return pressure"),
    "load_force": ("N", "force of another model on the jack, added to the load"),
    "closed": ("1", "not 0: commands are positions, m; else currents, A"),
    "command": ("1", "A or m"),
    "current": ("A", "current, digitised"),
    "spool": ("m", "spool position, digitised"),
    "pressure": ("Pa", "differential pressure, digitised"),
    "position": ("m", "jack position, digitised"),
    "true_current": ("A", "current"),
    "true_spool": ("m", "spool position"),
    "true_pressure": ("Pa", "differential pressure"),
    "true_position": ("m", "jack position"),
    "true_velocity": ("m/s", "jack velocity"),
    "predicted_spool": ("m", "spool position by the model"),
    "predicted_pressure": ("Pa", "differential pressure by the model"),
    "predicted_position": ("m", "jack position by the model"),
    "viscosity": ("1", "of the oil, over that at 40 degC"),
    "supply": ("Pa", "supply minus return pressure"),
    "alarms": ("1", "sum of 1 (spool, upper), 2 (lower), 4 (pressure, upper), 8 (lower)"),
}
"""Unit of measure and meaning of a variable that is not named alone."""


def export_fmus(
    actuator: Actuator,
    folder: Folder,
    *,
    hours: float = FALSE_ALARM_INTERVAL_H,
    platforms: Sequence[str] = (),
) -> list[str]:
    """Write units of simulator and monitor, each for both versions of FMI.

    actuator: whose data are in them as constants; folder: where to write; files of these names are
    replaced; hours: mean time between false alarms of the monitor, h; platforms: names in
    FMU_PLATFORMS, or "all"; none: this computer. ConfigurationError: no such platform, or no C
    compiler for it; InputOutputError: the folder cannot be written, or the compiler fails.
    """
    compilers = _compilers(platforms)
    tick = 1.0 / actuator.controller.rate
    models = _simulator(actuator), _monitor(actuator, hours)
    codes = iter(
        object_files(
            *(
                ObjectFile(
                    model.functions,
                    replace(HOST, triple=FMU_PLATFORMS[name].triple),
                    model.tables,
                    C_FUNCTIONS | ROUNDING_FUNCTIONS,
                    allowed=model.allowed,
                )
                for model in models
                for name in compilers
            )
        )
    )
    files: dict[str, bytes] = {}
    for model in models:
        code_of = {item: next(codes) for item in compilers}
        for version in FMI_VERSIONS:
            name = f"{model.name}_fmi{version[0]}"
            token = hashlib.sha256(b"".join(code_of.values()) + name.encode()).hexdigest()
            text = model_description(version, name, token, tick, model.meaning, model.variables)
            packed = {"modelDescription.xml": text}
            for item, compiler in compilers.items():
                place = FMU_PLATFORMS[item].folder if version == "2.0" else item
                library = f"{name}{FMU_PLATFORMS[item].suffix}"
                packed[f"binaries/{place}/{library}"] = link_shared(
                    compiler,
                    library,
                    {
                        "fmu.c": fill_template("fmu.c"),
                        "model.h": _fmu_header(model, name, token, tick),
                        "eha.o": code_of[item],
                    },
                )
            files[f"{name}.fmu"] = _packed(packed)
    options = {"actuator": actuator.name, "hours": hours, "platforms": list(compilers)}
    files[MANIFEST_FILE] = make_manifest(files, target="host", options=options)
    write_files(folder, files)
    return list(files)


def _compilers(platforms: Sequence[str]) -> dict[str, list[str]]:
    """Command of the C compiler by the platforms that a unit is for: this one's own, or Zig's."""
    for name in platforms:
        if name not in (*FMU_PLATFORMS, "all"):
            raise ConfigurationError(
                f"platform {name!r}: need one of {', '.join(FMU_PLATFORMS)}, all"
            )
    if platforms:
        names = FMU_PLATFORMS if "all" in platforms else platforms
        return {name: cross_compiler(FMU_PLATFORMS[name].zig) for name in names}
    compiler, own = c_compiler(), f"{platform.machine()}-{sys.platform}"
    if compiler is None:
        raise ConfigurationError("no C compiler (cc, or what CC names): a unit cannot be linked")
    if sys.platform != "linux" or own not in FMU_PLATFORMS:
        raise ConfigurationError(
            f"no units for {sys.platform} on {platform.machine()} by its own C compiler:"
            " name what they are for by --platform"
        )
    return {own: compiler}


def _simulator(actuator: Actuator) -> _FmuModel:
    of_both = (PointerArgument(), TableArgument("eha_plant"), PointerArgument())
    return _FmuModel(
        "eha_actuator",
        "Electrohydraulic actuator with faults and effects: command in, sensor signals out",
        actuator_variables(),
        (
            CFunction("eha_plant_start", start_plant, of_both),
            CFunction("eha_plant_tick", tick_plant, of_both),
        ),
        {"eha_plant": plant_plan(actuator)},
        PLANT_MEMORY.end,
        fill_template("fmu_actuator.h").decode(),
        C_LIBRARY_FUNCTIONS,
    )


def _monitor(actuator: Actuator, hours: float) -> _FmuModel:
    constants = plant_constants(actuator)
    of_both = (PointerArgument(), TableArgument("eha_plan"), PointerArgument())
    plan = monitor_plan(actuator, constants, design_cusum(hours, 1.0 / actuator.controller.rate))
    return _FmuModel(
        "eha_monitor",
        "Streaming monitor of an electrohydraulic actuator: residuals and their cumulative sums",
        monitor_variables(float(constants.PSR)),
        (
            CFunction("eha_monitor_init", prepare_monitor, of_both),
            CFunction("eha_monitor_push", push_tick, (PointerArgument(), DoublesArgument(5))),
        ),
        {"eha_plan": plan.tolist()},
        MONITOR_SIZE,
        fill_template("fmu_monitor.h.in", predicted=str(MONITOR.predicted)).decode(),
    )


def _fmu_header(model: _FmuModel, name: str, token: str, tick: float) -> bytes:
    counts: dict[str, int] = {}
    for item in model.variables:
        counts[item.causality] = counts.get(item.causality, 0) + 1
    fixed = "".join(
        "01"[item.is_fixed] for item in model.variables if item.causality == "parameter"
    )
    starts = ", ".join(repr(float(item.start)) for item in model.variables)
    lines: dict[str, Any] = {
        "MODEL": f'"{name}"',
        "TOKEN": f'"{token}"',
        "TICK": repr(tick),
        "VALUES": f"{len(model.variables)}u",
        "PARAMETERS": f"{counts['parameter']}u",
        "INPUTS": f"{counts['input']}u",
        "MEMORY": f"{model.memory}u",
        "FIXED": f'"{fixed}"',
        "STARTS": f"{{{starts}}}",
    }
    defined = "".join(f"#define EHA_{key} {value}\n" for key, value in lines.items())
    return (defined + model.hooks).encode()


def _packed(files: Mapping[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            # One date for all files (ZIP's first), so that the same kernels give the same unit.
            entry = zipfile.ZipInfo(name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, data)
    return content.getvalue()
