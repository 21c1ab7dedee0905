"""Exports a static library with header, C sources of the bus, example and manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any, Final

from numpy.typing import NDArray

from ehadiag.compile.elementary import (
    C_FUNCTIONS,
    ROUNDING_FUNCTIONS,
    square_root,
)
from ehadiag.compile.libraries import object_file
from ehadiag.compile.sources import source_hash
from ehadiag.compile.vector import BYTES_PER_NUMBER
from ehadiag.compile.worker import (
    CFunction,
    ObjectFile,
    PointerArgument,
    Processor,
    TableArgument,
    tool_versions,
)
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H, __version__
from ehadiag.export.plan import library_plan
from ehadiag.export.targets import (
    Target,
    c_compiler,
    link_shared,
    mark_either_convention,
    static_library,
)
from ehadiag.model.registry import unit_constants
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.monitor import monitor_memory
from ehadiag.monitor.plan import CusumDesign, design_cusum
from ehadiag.onboard import onboard_memory as identification
from ehadiag.onboard.c_interface import (
    c_identify_begin,
    c_identify_run,
    c_monitor_health,
    c_monitor_init,
    c_monitor_push,
    c_monitor_reset,
    c_unit_environment,
)
from ehadiag.onboard.onboard_memory import PLAN_IDENTITY, PLAN_TEST_SIZE, PLAN_TESTS
from firmware_iface.errors import InputOutputError, plain_name, reason_of
from firmware_iface.files import Folder
from firmware_iface.stored_test import StoredTest

FIRMWARE_MODULES: Final = (
    "check",
    "frames",
    "link",
    "samples",
    "stored_tests",
    "node",
    "diagnosis",
)
GENERATED_FIRMWARE_MODULE: Final = "eha_fcc"
FIRMWARE_C_FILES: Final = tuple(
    f"{name}.c" for name in (*FIRMWARE_MODULES, GENERATED_FIRMWARE_MODULE)
)


def firmware_sources() -> dict[str, bytes]:
    """Read C sources and headers by name, with includes as for one folder without others in it."""
    place = resources.files("firmware_iface").joinpath("c")
    files = {}
    for suffix in (".c", ".h"):
        for name in FIRMWARE_MODULES:
            text = place.joinpath(name + suffix).read_text("utf-8")
            files[name + suffix] = text.replace('"generated/', '"').encode()
        files[GENERATED_FIRMWARE_MODULE + suffix] = place.joinpath(
            "generated", GENERATED_FIRMWARE_MODULE + suffix
        ).read_bytes()
    return files


STATIC_LIBRARY_FILE: Final = "libeha.a"
HEADER_FILE: Final = "eha_monitor.h"
SHARED_LIBRARY_FILE: Final = "libeha.so"
MANIFEST_FILE: Final = "manifest.json"
EXPORT_SCHEMA: Final = "ehadiag.export/1"
ROOT_FUNCTIONS: Final[Mapping[str, Any]] = {"sqrt": square_root}
PLAN_TABLE: Final = "eha_plan"
UNMEASURED_FIGURES: Final = dict.fromkeys(
    ("bit_equality", "instructions_of_push", "instructions_of_identification"), "not measured"
)
MEASUREMENT_NEEDS: Final = "in the sources of ehadiag, with the target's compiler and QEMU"

PLAN = TableArgument(PLAN_TABLE)
EXPORTED_FUNCTIONS: Final = (
    CFunction("eha_unit_environment", c_unit_environment, (PointerArgument(), PointerArgument())),
    CFunction("eha_monitor_init", c_monitor_init, (PointerArgument(), PLAN, PointerArgument())),
    CFunction("eha_monitor_reset", c_monitor_reset, (PointerArgument(), PLAN, PointerArgument())),
    CFunction("eha_monitor_push", c_monitor_push, (PointerArgument(), PLAN, PointerArgument())),
    CFunction("eha_monitor_health", c_monitor_health, (PointerArgument(), PLAN)),
    CFunction("eha_identify_begin", c_identify_begin, (PointerArgument(), PLAN, PointerArgument())),
    CFunction(
        "eha_identify_run",
        c_identify_run,
        (PointerArgument(), PLAN, PointerArgument(), PointerArgument()),
    ),
)


def export_library(
    actuator: Actuator,
    target: Target,
    folder: Folder,
    *,
    hours: float = FALSE_ALARM_INTERVAL_H,
    shift: float = 1.0,
    tests: Sequence[StoredTest] | None = None,
) -> list[str]:
    """Write a library of monitor and identification for a target into a folder.

    actuator: whose data are in the library as constants; target: for what computer; folder: where
    to write; files of these names are replaced; hours: mean time between false alarms, h; shift: of
    the mean, in units of noise, that the sums are to find soonest; tests: of which recordings are
    identified, one for each kind of commands, None: the bundled ones. Returns names of the files.
    ConfigurationError: a number out of its range; InputOutputError: the folder cannot be written.
    """
    design = design_cusum(hours, 1.0 / actuator.controller.rate, shift)
    plan = library_plan(actuator, design, tests, single=target.processor.single)
    code = mark_either_convention(
        object_file(
            ObjectFile(
                EXPORTED_FUNCTIONS,
                target.processor,
                {PLAN_TABLE: plan.tolist()},
                _own_functions(target.processor),
                # They add so much to a number that nothing is left of its fraction but a rounding.
                exact=frozenset(ROUNDING_FUNCTIONS.values()),
            )
        )
    )
    library = static_library("eha.o", code, [item.name for item in EXPORTED_FUNCTIONS])
    names = {"version": __version__, "target": target.name}
    files = {
        STATIC_LIBRARY_FILE: library,
        HEADER_FILE: _library_header(actuator, target, design, hours, plan, names),
        "eha_identify.h": fill_template(
            "eha_identify.h.in",
            bytes=str(identification.ONBOARD.end * BYTES_PER_NUMBER),
            own=str(identification.ONBOARD.end - len(identification.OnboardOutcome._fields)),
            lanes=str(identification.ONBOARD_MODELS),
            open_ticks=f"{plan[PLAN_TESTS]:.0f}",
            closed_ticks=f"{plan[PLAN_TESTS + PLAN_TEST_SIZE]:.0f}",
            **names,
        ),
        "CMakeLists.txt": fill_template(
            "CMakeLists.txt.in",
            flags=";".join(target.flags),
            firmware=" ".join(FIRMWARE_C_FILES),
            **names,
        ),
        "example.c": fill_template("example.c"),
        **firmware_sources(),
    }
    compiler = c_compiler() if target.processor.shared else None
    if compiler is not None:
        # Objects alone: what is exported has no C part.
        files[SHARED_LIBRARY_FILE] = link_shared(
            compiler, SHARED_LIBRARY_FILE, {"eha.o": code}, ["-nostartfiles"]
        )
        files["eha.pc"] = fill_template("eha.pc.in", **names)
    files[MANIFEST_FILE] = make_manifest(
        files,
        target=target.name,
        processor={
            "triple": target.processor.triple or "of this computer",
            "cpu": target.processor.cpu,
            "features": target.processor.features,
            "roots": target.processor.roots,
            "single": target.processor.single,
        },
        compiler_flags=list(target.flags),
        options={"actuator": actuator.name, "hours": hours, "shift": shift},
        plan=_digest(plan),
        functions=[item.name for item in EXPORTED_FUNCTIONS],
        monitor_bytes=monitor_memory.MONITOR_SIZE * BYTES_PER_NUMBER,
        identification_bytes=identification.ONBOARD.end * BYTES_PER_NUMBER,
        object_bytes=len(code),
        measured=UNMEASURED_FIGURES
        | {"command": f"tools/study onboard --into FOLDER LOG, {MEASUREMENT_NEEDS}"},
    )
    write_files(folder, files)
    return list(files)


def _own_functions(processor: Processor) -> Mapping[str, Any]:
    """What stands for functions of the C library on a processor."""
    rounding = {} if processor.rounds else ROUNDING_FUNCTIONS
    return {**C_FUNCTIONS, **rounding, **({} if processor.roots else ROOT_FUNCTIONS)}


def _library_header(
    actuator: Actuator,
    target: Target,
    design: CusumDesign,
    hours: float,
    plan: NDArray[Any],
    names: Mapping[str, str],
) -> bytes:
    held = 3 + 2 + 4
    version, digest, serial = plan[PLAN_IDENTITY : PLAN_IDENTITY + 3].tolist()
    return fill_template(
        f"{HEADER_FILE}.in",
        meaning=target.meaning,
        # A comment must not be ended by a name.
        actuator=plain_name(actuator.name),
        severities="\n".join(
            f"    double {f'{name.lower()};':16} /* severity, 0 ... 1: {law.meaning} */"
            for name, law in FAULT_LAWS.items()
        ),
        zeros=", ".join("0.0" for _ in FAULT_LAWS),
        tick_us=f"{1e6 / actuator.controller.rate:g}",
        reference=f"{design.reference:g}",
        threshold=f"{design.threshold:.4g}",
        hours=f"{hours:g}",
        supply=repr(float(unit_constants(actuator).PSR)),
        library=f"{version:.1f}",
        plan=f"{digest:.1f}",
        serial=f"{serial:.1f}",
        bytes=str(monitor_memory.MONITOR_SIZE * BYTES_PER_NUMBER),
        before=str(monitor_memory.MONITOR.predicted),
        behind=str(monitor_memory.MONITOR_SIZE - monitor_memory.MONITOR.predicted - held),
        **names,
    )


def _digest(plan: NDArray[Any]) -> str:
    return hashlib.sha256(plan.astype("<f8").tobytes()).hexdigest()


def fill_template(name: str, **values: str) -> bytes:
    """Fill in a text of the package; files with places to fill have names that end in `.in`."""
    text = resources.files("ehadiag").joinpath("data", "export", name).read_text("utf-8")
    if name.endswith(".in"):
        text = Template(text).substitute(values)
    return text.encode()


def make_manifest(files: Mapping[str, bytes], **facts: Any) -> bytes:
    """Describe in JSON files by name, the versions that made them, and further facts."""
    content = {
        "schema": EXPORT_SCHEMA,
        "versions": {"ehadiag": __version__, **tool_versions()},
        "kernel_sources": source_hash("ehadiag.onboard.c_interface"),
        **facts,
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        },
    }
    return (json.dumps(content, indent=2) + "\n").encode()


def write_files(folder: Folder, files: Mapping[str, bytes]) -> None:
    """Write files by name into an open folder; a failure is an InputOutputError."""
    for name, data in files.items():
        try:
            folder.write(name, data)
        except OSError as error:
            raise InputOutputError(f"{folder.path / name}: {reason_of(error)}") from None
