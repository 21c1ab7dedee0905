"""A static library with its header, example, CMake file and manifest, for one target."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib import metadata, resources
from string import Template
from typing import Any, Final

from numpy.typing import NDArray

from ehadiag.assess.acceptance import (
    LEAST_SUPPLY,
    LONGEST_GAP_S,
    MOST_LOST,
    MOST_SATURATED,
    most_left,
)
from ehadiag.assess.verdict import FALSE_HEALTHY, FAULT_CHANCE, Levels
from ehadiag.compile.kernel_cache import source_hash
from ehadiag.compile.object_code import (
    Function,
    Numbers,
    Pointer,
    Processor,
    Table,
    object_code,
    tool_versions,
)
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.errors import InputOutputError, reason_of
from ehadiag.core.false_alarms import HOURS_BETWEEN
from ehadiag.core.folder import Folder
from ehadiag.core.printable import plain_name
from ehadiag.export.archive import archive
from ehadiag.export.arm_attributes import either_convention
from ehadiag.export.firmware import SOURCES, firmware
from ehadiag.export.linking import c_compiler, link_shared
from ehadiag.export.targets import Target
from ehadiag.identify.estimates import NOT_SHOWN_STD
from ehadiag.model.exponential import exponential, exponential_less_one
from ehadiag.model.unit import unit_constants
from ehadiag.monitor import layout
from ehadiag.monitor.cusum import CusumDesign, design_cusum
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.plan import monitor_plan
from ehadiag.monitor.prepare import prepare, rest
from ehadiag.onboard import layout as identification
from ehadiag.onboard.elementary import (
    cosine,
    logarithm,
    round_down,
    round_even,
    square_root,
)
from ehadiag.onboard.environment import set_environment
from ehadiag.onboard.kernels import begin_identification, identify_some
from ehadiag.onboard.rules import Rules, with_rules

__all__ = [
    "HEADER",
    "LIBRARY",
    "MANIFEST",
    "OWN_FUNCTIONS",
    "SHARED",
    "export_library",
    "manifest",
    "rules",
    "template",
    "write",
]

LIBRARY: Final = "libeha.a"
HEADER: Final = "eha_monitor.h"
SHARED: Final = "libeha.so"
MANIFEST: Final = "manifest.json"
SCHEMA: Final = "ehadiag.export/1"
OWN_FUNCTIONS: Final[Mapping[str, Any]] = {
    "exp": exponential,
    "expm1": exponential_less_one,
    "log": logarithm,
    "cos": cosine,
}
"""What stands for functions of the C library, whose last digit differs from one to the next."""
ROUNDING: Final[Mapping[str, Any]] = {"rint": round_even, "floor": round_down}
"""The same for a processor without such instructions; exact, so that no digit depends on it."""
ROOT: Final[Mapping[str, Any]] = {"sqrt": square_root}
PLAN: Final = "eha_plan"
NOT_MEASURED: Final = dict.fromkeys(
    ("bit_equality", "instructions_of_push", "instructions_of_identification"), "not measured"
)
NEEDED: Final = "in the sources of ehadiag, with the target's compiler and QEMU"

MONITOR: Final = (
    Function("eha_monitor_init", prepare, (Pointer(), Table(PLAN), Pointer())),
    Function("eha_monitor_reset", rest, (Pointer(), Numbers(1))),
    Function("eha_monitor_push", push_tick, (Pointer(), Numbers(5))),
)
SURROUNDINGS: Final = (Function("eha_unit_environment", set_environment, (Pointer(), Numbers(3))),)

IDENTIFICATION: Final = (
    Function("eha_identify_begin", begin_identification, (Pointer(), Table(PLAN), Pointer())),
    Function("eha_identify_run", identify_some, (Pointer(), Table(PLAN), Pointer(), Numbers(2))),
)
FUNCTIONS: Final = (*MONITOR, *SURROUNDINGS, *IDENTIFICATION)


def export_library(
    actuator: Actuator,
    target: Target,
    folder: Folder,
    *,
    hours: float = HOURS_BETWEEN,
    shift: float = 1.0,
) -> list[str]:
    """Write a library of monitor and identification for a target into a folder.

    Parameters
    ----------
    actuator : Actuator
        Whose data are in the library as constants.
    target : Target
        For what computer.
    folder : Folder
        Where to write; files of these names are replaced.
    hours : float
        Mean time between false alarms, h.
    shift : float
        Of the mean, in units of noise, that the sums are to find soonest.

    Returns
    -------
    list[str]
        Names of the files.

    Raises
    ------
    ConfigurationError
        A number out of its range.
    InputOutputError
        The folder cannot be written.
    """
    design = design_cusum(hours, 1.0 / actuator.controller.rate, shift)
    plan = with_rules(monitor_plan(actuator, unit_constants(actuator), design), rules(actuator))
    code = either_convention(
        object_code(
            FUNCTIONS,
            {PLAN: plan.tolist()},
            _own_functions(target.processor),
            target.processor,
            # They add so much to a number that nothing is left of its fraction but a rounding.
            exact=frozenset(ROUNDING.values()),
        )
    )
    library = archive("eha.o", code, [item.name for item in FUNCTIONS])
    names = {"version": metadata.version("ehadiag"), "target": target.name}
    files = {
        LIBRARY: library,
        HEADER: _header(actuator, target, design, hours, names),
        "eha_identify.h": template(
            "eha_identify.h.in",
            bytes=str(identification.SIZE * layout.NUMBER),
            own=str(identification.SIZE - len(identification.Outcome._fields)),
            lanes=str(identification.MONITORS),
            **names,
        ),
        "CMakeLists.txt": template(
            "CMakeLists.txt.in", flags=";".join(target.flags), firmware=" ".join(SOURCES), **names
        ),
        "example.c": template("example.c"),
        **firmware(),
    }
    compiler = c_compiler() if target.processor.shared else None
    if compiler is not None:
        # Objects alone: what is exported has no C part.
        files[SHARED] = link_shared(compiler, SHARED, {"eha.o": code}, ["-nostartfiles"])
        files["eha.pc"] = template("eha.pc.in", **names)
    files[MANIFEST] = manifest(
        files,
        target=target.name,
        processor={
            "triple": target.processor.triple or "of this computer",
            "cpu": target.processor.cpu,
            "features": target.processor.features,
            "doubles": target.processor.doubles,
            "single": target.processor.single,
        },
        compiler_flags=list(target.flags),
        options={"actuator": actuator.name, "hours": hours, "shift": shift},
        plan=_digest(plan),
        functions=[item.name for item in FUNCTIONS],
        monitor_bytes=layout.SIZE * layout.NUMBER,
        identification_bytes=identification.SIZE * layout.NUMBER,
        object_bytes=len(code),
        measured=NOT_MEASURED | {"command": f"tools/onboard --into FOLDER LOG, {NEEDED}"},
    )
    write(folder, files)
    return list(files)


def rules(actuator: Actuator) -> Rules:
    """What a verdict on board goes by: the rules of `ehadiag diagnose` at its default levels.

    Parameters
    ----------
    actuator : Actuator
        What a calibration of the unit could not explain is no reason against a verdict.

    Returns
    -------
    Rules
        The limits.
    """
    levels, (outliers, rms) = Levels(), most_left(actuator.calibration)
    _, spool, pressure, position = (channel.ends for channel in actuator_channels(actuator))
    return Rules(
        advisory=levels.advisory,
        limit=levels.limit,
        false_healthy=FALSE_HEALTHY,
        fault_chance=FAULT_CHANCE,
        most_outliers=outliers,
        most_rms=rms,
        most_std=NOT_SHOWN_STD,
        most_lost=MOST_LOST,
        longest_gap=LONGEST_GAP_S * actuator.controller.rate,
        most_saturated=MOST_SATURATED,
        least_supply=LEAST_SUPPLY * actuator.servovalve.PSR,
        spool_low=spool[0],
        spool_high=spool[1],
        pressure_low=pressure[0],
        pressure_high=pressure[1],
        position_low=position[0],
        position_high=position[1],
    )


def _own_functions(processor: Processor) -> Mapping[str, Any]:
    """What stands for functions of the C library on a processor."""
    rounding = {} if processor.rounds else ROUNDING
    return {**OWN_FUNCTIONS, **rounding, **({} if processor.doubles else ROOT)}


def _header(
    actuator: Actuator,
    target: Target,
    design: CusumDesign,
    hours: float,
    names: Mapping[str, str],
) -> bytes:
    held = 3 + 2 + 4
    return template(
        f"{HEADER}.in",
        meaning=target.meaning,
        # A comment must not be ended by a name.
        actuator=plain_name(actuator.name),
        tick_us=f"{1e6 / actuator.controller.rate:g}",
        reference=f"{design.reference:g}",
        threshold=f"{design.threshold:.4g}",
        hours=f"{hours:g}",
        supply=repr(float(unit_constants(actuator).PSR)),
        bytes=str(layout.SIZE * layout.NUMBER),
        before=str(layout.PREDICTED),
        behind=str(layout.SIZE - layout.PREDICTED - held),
        **names,
    )


def _digest(plan: NDArray[Any]) -> str:
    return hashlib.sha256(plan.astype("<f8").tobytes()).hexdigest()


def template(name: str, **values: str) -> bytes:
    """Fill in a text of the package.

    Parameters
    ----------
    name : str
        Of its file; the names of those with places to fill end in `.in`.
    **values : str
        What to fill in.

    Returns
    -------
    bytes
        The text.
    """
    text = resources.files("ehadiag").joinpath("data", "export", name).read_text("utf-8")
    if name.endswith(".in"):
        text = Template(text).substitute(values)
    return text.encode()


def manifest(files: Mapping[str, bytes], **facts: Any) -> bytes:
    """Say in JSON of what an export was made, and what it holds.

    Parameters
    ----------
    files : Mapping[str, bytes]
        By name.
    **facts : Any
        Further members.

    Returns
    -------
    bytes
        The text.
    """
    content = {
        "schema": SCHEMA,
        "versions": {"ehadiag": metadata.version("ehadiag"), **tool_versions()},
        "kernel_sources": source_hash(),
        **facts,
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        },
    }
    return (json.dumps(content, indent=2) + "\n").encode()


def write(folder: Folder, files: Mapping[str, bytes]) -> None:
    """Write files into a folder.

    Parameters
    ----------
    folder : Folder
        The folder, open.
    files : Mapping[str, bytes]
        By name.

    Raises
    ------
    InputOutputError
        It cannot be written.
    """
    for name, data in files.items():
        try:
            folder.write(name, data)
        except OSError as error:
            raise InputOutputError(f"{folder.path / name}: {reason_of(error)}") from None
