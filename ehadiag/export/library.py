"""Exports a static library with header, C sources of the bus, example and manifest.

Its plan is what the actuator's data and its stored tests fix, as numbers.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.verdict import Levels, residual_limits
from ehadiag.compile.elementary import (
    C_FUNCTIONS,
    ROUNDING_FUNCTIONS,
    square_root,
)
from ehadiag.compile.jit import Array
from ehadiag.compile.libraries import object_files, source_hash, tool_versions
from ehadiag.compile.vector import BYTES_PER_NUMBER
from ehadiag.compile.worker import (
    CFunction,
    ObjectFile,
    PointerArgument,
    Processor,
    TableArgument,
)
from ehadiag.core.actuator import MAX_NOISE_EXCESS, Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H, __version__
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.criteria import FIT, LOSSES, READINGS, RECORDING, VERDICT
from ehadiag.export.targets import (
    Target,
    c_compiler,
    link_shared,
    mark_either_convention,
    static_library,
)
from ehadiag.identify.estimates import FIRST_STAGE_STD
from ehadiag.identify.prior import DAILY_PRIORS, calibration_covariance, unit_prior
from ehadiag.model.plant import PlantConstants, plant_constants
from ehadiag.model.registry import Unknowns, unit_constants
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.monitor import monitor_memory
from ehadiag.monitor.monitor_memory import LibraryIdentity
from ehadiag.monitor.plan import CusumDesign, design_cusum, monitor_plan
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
from ehadiag.onboard.onboard_memory import (
    PLAN_IDENTITY,
    PLAN_TEST_SIZE,
    PLAN_TESTS,
    PLAN_WINDOWS,
    VerdictRules,
)
from firmware_iface.errors import ConfigurationError, InputOutputError, plain_name, reason_of
from firmware_iface.files import Folder
from firmware_iface.stored_test import StoredTest, TimeWindow, bundled_tests

SMALLEST = {False: 2.0**-540, True: 2.0**-82}
"""Root of what makes of a pressure in Pa a number that is lost where small ones are flushed to
zero, by whether results are rounded to single precision, 1."""


def library_plan(
    actuator: Actuator,
    design: CusumDesign,
    tests: Sequence[StoredTest] | None = None,
    *,
    single: bool = False,
) -> Array:
    """Plan of a library, see `ehadiag.onboard.onboard_memory`.

    tests: one for each kind of commands, of which recordings are identified; None: the bundled
    ones. single: whether results are rounded to single precision. Two tests of one kind, or one at
    another rate than the actuator's, raise ConfigurationError.
    """
    uncertain, base = uncertain_constants(actuator), unit_constants(actuator)
    rules, rows = verdict_rules(actuator), uncertain
    begin = [*monitor_plan(actuator, base, design), *rules]
    if rules.exponents > 0.0:
        # With the largest exponent friction is less than as new (`over_exponents`).
        largest = actuator.servovalve.clogging_range[1]
        rows = [row._replace(CLE=largest, FSS=0.0) for row in (*uncertain, base)]
    end = [
        *_test_numbers(tests or tuple(bundled_tests().values()), actuator.controller.rate),
        float(len(uncertain)),
        *(number for row in rows for number in row),
    ]
    numbers = np.array([*begin, *end], dtype="<f8")
    # 48 bits: a double holds 53.
    digest = int.from_bytes(hashlib.sha256(numbers.tobytes()).digest()[:6], "big")
    return np.array([*begin, *identity_of(actuator, float(digest), single=single), *end])


def identity_of(actuator: Actuator, digest: float, *, single: bool = False) -> LibraryIdentity:
    """Identity of a library: digest of its plan."""
    major, minor, patch = (int(part) for part in re.findall(r"\d+", __version__)[:3])
    version = 1e6 * major + 1e3 * minor + patch
    serial = actuator.calibration.serial if actuator.calibration else None
    return LibraryIdentity(version, digest, float(serial or 0), SMALLEST[single])


def exported_unit(unit: Sequence[float], plan: Array) -> Array:
    """Return what C code hands to a library: a unit, and what the library's header says of it."""
    return np.array([*unit, *plan[PLAN_IDENTITY : PLAN_IDENTITY + 3]])


def uncertain_constants(actuator: Actuator) -> list[PlantConstants]:
    """Constants of a calibrated unit, a deviation off in each direction that is not certain.

    Columns of a root of the calibration's covariance.
    """
    calibration = actuator.calibration
    if calibration is None:
        return []
    base = plant_constants(actuator)._replace(NPL=float(calibration.plays))
    names, effects = calibration.parameters, calibration.effects
    root = np.linalg.cholesky(calibration_covariance(calibration))
    moved = [dict(zip(names, column, strict=True)) for column in root.T]
    return [
        Unknowns((), (base,), {**effects, **_sums(effects, item)}).constants(np.empty(0))
        for item in moved
    ]


def _sums(effects: Mapping[str, float], moved: Mapping[str, float]) -> dict[str, float]:
    return {name: effects.get(name, 0.0) + float(value) for name, value in moved.items()}


def _test_numbers(tests: Sequence[StoredTest], rate: float) -> list[float]:
    """Ticks and windows of the tests, in open loop first; zeros where there is none."""
    out: list[float] = []
    for closed in (False, True):
        mine = [item for item in tests if item.closed_loop is closed]
        if len(mine) > 1:
            names = ", ".join(item.name for item in mine)
            raise ConfigurationError(f"tests {names}: a library has one of each kind of commands")
        numbers = [0.0] * PLAN_TEST_SIZE
        for test in mine:
            if test.rate != rate:
                raise ConfigurationError(f"test {test.name}: rate {test.rate:g}, need {rate:g} Hz")
            windows = test.windows
            numbers = [float(test.ticks)]
            for search in (windows.FDJ, windows.Kintas, windows.FSS, windows.refinement):
                numbers += _window_numbers(search, rate)
        out += numbers
    return out


def _window_numbers(windows: Sequence[TimeWindow], rate: float) -> list[float]:
    """First tick and end of the longest windows, in their order, then zeros."""
    longest = sorted(windows, key=lambda span: span[0] - span[1])[:PLAN_WINDOWS]
    ticks = [float(round(time * rate)) for span in sorted(longest) for time in span]
    return [*ticks, *[0.0] * (2 * PLAN_WINDOWS - len(ticks))]


BUS_VISCOSITY_STD: Final = 2.5e-3
"""Deviation of the oil's viscosity by the default bus's steps of 0.1 K at -20 degC, relative, 1; of
hotter oil it is less, and does less. A bus with coarser steps errs by more than that."""
BUS_SUPPLY_STD: Final = 4.1e3
"""Deviation of the supply by the default bus's steps of 0.01 MPa of supply and return, Pa."""


def verdict_rules(actuator: Actuator) -> VerdictRules:
    """Return the rules of a verdict on board: those of `ehadiag diagnose` at its default levels.

    What a calibration of the unit could not explain is no reason against a verdict.
    """
    levels, (outliers, rms) = Levels(), residual_limits(actuator.calibration)
    prior, valve = unit_prior(actuator), actuator.servovalve
    low, high = prior.exponents
    calibration = actuator.calibration
    explained = calibration is None or calibration.fit.left == 0.0
    exact = explained and low == high and not any(prior.discrepancy.values())
    _, spool, pressure, position = (channel.ends for channel in actuator_channels(actuator))
    return VerdictRules(
        advisory=levels.advisory,
        limit=levels.limit,
        false_healthy=VERDICT.max_chance_false_healthy,
        fault_chance=VERDICT.min_chance_fault,
        # Where nothing is in doubt but the noise, what is left is an effect; the package frees it.
        most_outliers=FIT.max_outliers_of_noise if exact else outliers,
        most_rms=rms,
        most_excess=MAX_NOISE_EXCESS if exact and calibration is None else math.inf,
        search_outliers=max(FIT.max_outliers_of_noise, outliers - FIT.max_outlier_share),
        most_anchored=float(FIT.max_anchor_count),
        most_std=FIT.max_shown_std,
        most_lost=1.0 - RECORDING.min_sample_share,
        longest_gap=RECORDING.max_sample_gap_s * actuator.controller.rate,
        most_saturated=LOSSES.max_wrong_share,
        least_supply=READINGS.min_supply_pressure_share * valve.PSR,
        **{f"discrepancy_{name}": prior.std.get(name, 0.0) for name in FAULT_LAWS},
        **{f"law_{name}": size for name, size in prior.discrepancy.items()},
        viscosity_std=DAILY_PRIORS["oil_viscosity"].std if calibration else BUS_VISCOSITY_STD,
        supply_std=DAILY_PRIORS["supply_pressure"].std if calibration else BUS_SUPPLY_STD,
        exponents=high - low,
        first_stage=FIRST_STAGE_STD,
        friction_new=valve.FSS0 / valve.FSS1 if low < high else 0.0,
        spool_low=spool[0],
        spool_high=spool[1],
        pressure_low=pressure[0],
        pressure_high=pressure[1],
        position_low=position[0],
        position_high=position[1],
    )


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
    (code,) = object_files(
        ObjectFile(
            EXPORTED_FUNCTIONS,
            target.processor,
            {PLAN_TABLE: plan.tolist()},
            _own_functions(target.processor),
            # They add so much to a number that nothing is left of its fraction but a rounding.
            exact=frozenset(ROUNDING_FUNCTIONS.values()),
        )
    )
    code = mark_either_convention(code)
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
