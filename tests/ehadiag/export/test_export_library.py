"""Exported libraries: the package's own monitor here, and the same digits in every emulator."""

import hashlib
import json
import platform
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from exported import Loaded, compile_together, exported, object_of
from places import LOGS, ROOT

from ehadiag import ConfigurationError, Monitor, default_actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.export.library import FIRMWARE_C_FILES, export_library, exported_unit, library_plan
from ehadiag.export.targets import TARGETS, find_target
from ehadiag.model.simd_layout import ROWS
from ehadiag.monitor.monitor_memory import MODEL, MONITOR, MONITOR_SIZE
from ehadiag.monitor.plan import design_cusum
from ehadiag.onboard.c_interface import ERRORS, HEALTH
from ehadiag.onboard.onboard_memory import ONBOARD
from ehadiag_tools.onboard.replay import (
    EMULATED,
    identified,
    missing,
    replayed,
    run_program,
    ticks_of,
    unit_of,
)
from ehadiag_tools.onboard.study import REFERENCE
from firmware_iface.signals.recordings import read_recording

SEVERITIES = (0.3, 0.4, 0.2)
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
COMPILER = shutil.which("cc")
MOST_INSTRUCTIONS_OF_A_SLICE = 2_000_000


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("exports")


@pytest.fixture(scope="module")
def together(place):
    names = [item.target for item in EMULATED if not missing(item)]
    compile_together([name for name in names if "powerpc" not in name], place)


def of_targets(test):
    """Mark a slow test of other targets: one process runs all of them, and compiles once."""
    marks = (pytest.mark.slow, pytest.mark.xdist_group("exports"))
    for mark in (*marks, pytest.mark.usefixtures("together")):
        test = mark(test)
    return test


@pytest.fixture(scope="module")
def loaded(place):
    return Loaded(object_of((exported("host", place) / "libeha.a").read_bytes()))


PLAN = library_plan(default_actuator(), design_cusum(FALSE_ALARM_INTERVAL_H, 1e-3))


def started(loaded, unit, numbers):
    start = exported_unit(unit, PLAN)
    return loaded.function("eha_monitor_init", 2)(numbers.ctypes.data, start.ctypes.data)


@pytest.mark.parametrize("log", ["paper-closed-1.blf", "lossy-open.blf"])
def test_the_host_is_the_monitor_of_the_package(loaded, log):
    """To last digits: exported, each product and each sum is rounded by itself."""
    recording = read_recording(LOGS / log)
    ticks = ticks_of(recording)
    monitor = Monitor(
        default_actuator(), SEVERITIES, recording.environment, mode=recording.samples.mode
    )
    numbers = np.zeros(MONITOR_SIZE)
    assert started(loaded, unit_of(recording, SEVERITIES), numbers) == 0
    push = loaded.function("eha_monitor_push", 2)
    seen = numbers[MONITOR.predicted : MONITOR.cusum + 4]
    for tick in ticks:
        alarms = push(numbers.ctypes.data, tick.ctypes.data)
        reading = monitor.push(tuple(tick.tolist()))
        own = np.concatenate([reading.predicted, reading.residual, reading.cusum.ravel()])
        np.testing.assert_allclose(seen, own, rtol=1e-10, atol=1e-10)
        assert alarms == int(reading.alarmed.ravel() @ np.array([1, 2, 4, 8]))


@pytest.mark.parametrize("index", range(8))
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_number_that_cannot_be_is_refused_and_nothing_written(loaded, index, wrong):
    unit = [0.1, 0.1, 0.1, 0.0, 0.0, 1.0, 20e6, 0.0]
    unit[index] = wrong
    numbers = np.full(MONITOR_SIZE, 3.0)
    assert started(loaded, unit, numbers) == ERRORS.range
    assert (numbers == 3.0).all()
    job, start = np.full(ONBOARD.end, 3.0), exported_unit(unit, PLAN)
    begin = loaded.function("eha_identify_begin", 2)
    assert begin(job.ctypes.data, start.ctypes.data) == ERRORS.range
    assert (job == 3.0).all()


@pytest.mark.parametrize(
    ("index", "wrong"),
    [(0, -0.01), (1, 1.01), (3, 1.0), (4, 1e9), (5, 0.0), (5, 1e300), (5, 1e-3), (6, -1.0),
     (6, 20.0), (6, 200.0), (6, 2900.0), (6, 1e300), (6, 5e-324)],
)  # fmt: skip
def test_a_number_out_of_its_range_is_refused(loaded, index, wrong):
    """A viscosity of no oil, an offset beyond the converter, a supply in MPa, bar or psi."""
    unit = [0.1, 0.1, 0.1, 0.0, 0.0, 1.0, 20e6, 0.0]
    unit[index] = wrong
    numbers = np.full(MONITOR_SIZE, 3.0)
    assert started(loaded, unit, numbers) == ERRORS.range
    assert (numbers == 3.0).all()


GOOD_UNIT = [0.1, 0.1, 0.1, 0.0, 0.0, 1.0, 20e6, 0.0]


def ready(loaded):
    """Memory of a monitor that has begun."""
    numbers = np.zeros(MONITOR_SIZE)
    assert started(loaded, GOOD_UNIT, numbers) == 0
    return numbers


def health(loaded, numbers):
    return loaded.function("eha_monitor_health", 1)(numbers.ctypes.data)


def pushed(loaded, numbers, tick, times=1):
    given = np.array(tick, dtype=np.float64)
    for _ in range(times):
        last = loaded.function("eha_monitor_push", 2)(numbers.ctypes.data, given.ctypes.data)
    return last


@pytest.mark.parametrize(
    ("name", "count"),
    [("eha_unit_environment", 2), ("eha_monitor_init", 2), ("eha_monitor_reset", 2),
     ("eha_monitor_push", 2), ("eha_identify_begin", 2), ("eha_identify_run", 3)],
)  # fmt: skip
def test_a_pointer_that_is_null_or_not_aligned_is_refused(loaded, name, count):
    memory = np.full(ONBOARD.end, 3.0)
    call = loaded.function(name, count)
    for wrong in (0, memory.ctypes.data + 4):
        for index in range(count):
            pointers = [memory.ctypes.data] * count
            pointers[index] = wrong
            assert call(*pointers) == ERRORS.pointer
    assert (memory == 3.0).all()
    assert loaded.function("eha_monitor_health", 1)(0) == HEALTH.object


@pytest.mark.parametrize("content", ["zeros", "noise", "NaN", "the other kind"])
def test_an_object_that_was_never_begun_is_refused_and_as_it_was(loaded, content):
    rng, size = np.random.default_rng(3), ONBOARD.end
    memory = {
        "zeros": np.zeros(size),
        "noise": rng.integers(0, 2**63, size, dtype=np.uint64).view(np.float64),
        "NaN": np.full(size, np.nan),
        "the other kind": np.zeros(size),
    }[content]
    run = loaded.function("eha_identify_run", 3)
    if content == "the other kind":
        unit = exported_unit(GOOD_UNIT, PLAN)
        begin = loaded.function("eha_identify_begin", 2)
        assert begin(memory.ctypes.data, unit.ctypes.data) == 0
        run = loaded.function("eha_monitor_push", 2)
    before = memory.tobytes()
    tick, spool = np.zeros(5), np.zeros(1)
    push, reset = loaded.function("eha_monitor_push", 2), loaded.function("eha_monitor_reset", 2)
    assert push(memory.ctypes.data, tick.ctypes.data) == ERRORS.object
    assert reset(memory.ctypes.data, spool.ctypes.data) == ERRORS.object
    assert health(loaded, memory) == HEALTH.object
    if content != "the other kind":
        slices = np.array([5500.0, 1.0])
        recording = np.zeros((5500, 5))
        pointers = memory.ctypes.data, recording.ctypes.data, slices.ctypes.data
        assert run(*pointers) == ERRORS.object
    assert memory.tobytes() == before


@pytest.mark.parametrize(("member", "wrong"), [(8, 1.0), (9, 12345.0), (8, np.nan), (9, np.nan)])
def test_another_library_s_header_is_noticed(loaded, member, wrong):
    unit, numbers = exported_unit(GOOD_UNIT, PLAN), np.full(MONITOR_SIZE, 3.0)
    unit[member] = wrong
    init = loaded.function("eha_monitor_init", 2)
    assert init(numbers.ctypes.data, unit.ctypes.data) == ERRORS.library
    assert (numbers == 3.0).all()


def test_every_serial_number_runs_with_the_data_of_a_type(loaded):
    unit, numbers = exported_unit(GOOD_UNIT, PLAN), np.zeros(MONITOR_SIZE)
    unit[10] = 4711.0
    assert loaded.function("eha_monitor_init", 2)(numbers.ctypes.data, unit.ctypes.data) == 0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_reset_to_no_number_is_refused(loaded, wrong):
    numbers, spool = ready(loaded), np.array([wrong])
    before = numbers.tobytes()
    reset = loaded.function("eha_monitor_reset", 2)
    assert reset(numbers.ctypes.data, spool.ctypes.data) == ERRORS.range
    assert numbers.tobytes() == before


@pytest.mark.parametrize("index", range(5))
@pytest.mark.parametrize("wrong", [1e300, -1e300, np.inf, 5e3])
def test_a_number_in_the_wrong_unit_counts_as_lost_and_shows_in_the_health(loaded, index, wrong):
    """A command in mA, a spool in mm: the monitor is not spoilt by it."""
    wrong *= 1e6 if index == 3 else 1.0
    numbers, other = ready(loaded), ready(loaded)
    tick = [2e-3, 2e-3, 1e-5, 1e5, 0.0]
    bad, lost = list(tick), list(tick)
    bad[index], lost[index] = wrong, np.nan
    assert health(loaded, numbers) == 0
    pushed(loaded, numbers, bad)
    pushed(loaded, other, lost)
    assert health(loaded, numbers) == HEALTH.beyond
    assert numbers[MONITOR.predicted : MONITOR.model].tobytes() == (
        other[MONITOR.predicted : MONITOR.model].tobytes()
    )
    pushed(loaded, numbers, tick)
    assert health(loaded, numbers) == 0


def test_a_monitor_without_samples_is_not_able_to_judge(loaded):
    numbers = ready(loaded)
    pushed(loaded, numbers, [np.nan] * 5, times=250)
    assert health(loaded, numbers) == 0
    pushed(loaded, numbers, [np.nan] * 5)
    assert health(loaded, numbers) == HEALTH.spool + HEALTH.pressure + HEALTH.command
    pushed(loaded, numbers, [0.0, np.nan, 0.0, 0.0, 0.0])
    assert health(loaded, numbers) == 0


@pytest.mark.parametrize("index", [MONITOR.control, MODEL.state + ROWS.spool])
def test_a_model_without_numbers_is_not_able_to_judge(loaded, index):
    numbers = ready(loaded)
    numbers[index] = np.nan
    pushed(loaded, numbers, [0.0] * 5)
    assert health(loaded, numbers) & HEALTH.model


SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
WHOLE_JOBS = ("host", "host-single", "cortex-m7")
"""Targets on which a whole identification is watched for exceptions; on others its beginning."""
FEWEST_KINDS = 250
"""Of bad input that a target must hold against, 1; some have no other arithmetic to be set."""


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
@pytest.mark.parametrize("sane", [False, True])
def test_bad_input_on_this_computer_and_without_floating_point_exceptions(sane, place, tmp_path):
    host = EMULATED[0]
    options = (*SANITIZERS, *host.options[1:]) if sane else host.options
    assert_holds(replace(host, options=options), place, tmp_path)


@of_targets
@pytest.mark.parametrize("name", ["host-single", "cortex-m7", "powerpc-e500mc"])
def test_bad_input_on_a_target(name, place, tmp_path):
    emulator = next(item for item in EMULATED if item.target == name)
    if missing(emulator):
        pytest.skip(f"not installed: {', '.join(missing(emulator))}")
    if name not in WHOLE_JOBS:
        emulator = replace(emulator, options=("-DSLICES=2", *emulator.options))
    assert_holds(emulator, place, tmp_path)


def assert_holds(emulator, place, work):
    """Each kind of bad input has the code, reason or health that it must have."""
    said = run_program(emulator, exported(emulator.target, place), "misuse.c", work)
    found = re.fullmatch(r"nothing wrong in (\d+) kinds of input\n", said)
    assert found, said
    assert int(found[1]) >= FEWEST_KINDS


@pytest.mark.skipif(platform.machine() != "x86_64", reason="not an x86-64")
@pytest.mark.skipif(not shutil.which("objdump"), reason="no objdump here")
def test_the_host_library_needs_no_more_than_x86_64(place):
    """No register of AVX, which is 256 or 512 bits wide, and no rounding of SSE4.1."""
    done = subprocess.run(
        ["objdump", "-d", exported("host", place) / "libeha.a"], capture_output=True, check=True
    )
    assert b"mulsd" in done.stdout
    assert not re.search(rb"%[yz]mm|\bv[a-z]+sd\b|\bround[sp]d\b", done.stdout)


def test_reset_begins_anew(loaded):
    unit = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 20e6, 0.0]
    one, two = np.zeros(MONITOR_SIZE), np.zeros(MONITOR_SIZE)
    push, reset = (loaded.function("eha_monitor_push", 2), loaded.function("eha_monitor_reset", 2))
    tick, spool = np.array([5e-3, 5e-3, 1e-5, 1e5, 0.0]), np.array([2e-5])
    for numbers in (one, two):
        assert started(loaded, unit, numbers) == 0
    for _ in range(40):
        push(one.ctypes.data, tick.ctypes.data)
    for numbers in (one, two):
        reset(numbers.ctypes.data, spool.ctypes.data)
        push(numbers.ctypes.data, tick.ctypes.data)
    assert one[: MONITOR.cusum].tobytes() == two[: MONITOR.cusum].tobytes()


def test_the_manifest_tells_what_was_written(place):
    out = exported("host", place)
    told = json.loads((out / "manifest.json").read_text())
    assert told["target"] == "host"
    for name, facts in told["files"].items():
        content = (out / name).read_bytes()
        assert facts == {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def test_an_unknown_target_is_named():
    with pytest.raises(ConfigurationError, match="'pdp11': need one of host"):
        find_target("pdp11")


def test_every_target_can_be_emulated():
    assert [item.target for item in EMULATED] == [item.name for item in TARGETS]


@of_targets
@pytest.mark.parametrize("emulator", EMULATED, ids=lambda item: item.target)
def test_a_target_has_the_digits_of_the_host(emulator, place, tmp_path):
    absent = missing(emulator)
    if absent:
        pytest.skip(f"not installed: {', '.join(absent)}")
    recording = read_recording(LOGS / "paper-closed-1.blf")
    ticks, unit = ticks_of(recording)[:600], unit_of(recording, SEVERITIES)
    name = REFERENCE[find_target(emulator.target).processor.single]
    host = next(item for item in EMULATED if item.target == name)
    expected = replayed(host, exported(name, place), unit, ticks, tmp_path).lines
    replay = replayed(emulator, exported(emulator.target, place), unit, ticks, tmp_path)
    assert replay.lines == expected
    assert 0 < replay.push_stack <= 3584
    assert 0 < replay.init_stack <= 2048


@of_targets
@pytest.mark.parametrize("target", ["cortex-m7", "powerpc-e500mc"])
def test_the_identification_has_the_digits_of_the_host(target, place, tmp_path):
    host, other = (
        next(item for item in EMULATED if item.target == name) for name in ("host", target)
    )
    absent = missing(host) + missing(other)
    if absent:
        pytest.skip(f"not installed: {', '.join(absent)}")
    recording = read_recording(LOGS / "paper-open-1.blf")
    ticks, unit = ticks_of(recording)[2300:2700], unit_of(recording, (0.0, 0.0, 0.0))
    expected = identified(host, exported("host", place, len(ticks)), unit, ticks, tmp_path)
    assert expected.bits.startswith("0 ")
    assert expected.outcome.runs > 50.0
    found = identified(other, exported(target, place, len(ticks)), unit, ticks, tmp_path)
    assert found.bits == expected.bits
    assert 0 < found.stack <= 4608
    if "-DCOUNTED" in other.options:
        assert found.millions > 0
        assert 0 < found.longest <= MOST_INSTRUCTIONS_OF_A_SLICE


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
@pytest.mark.parametrize("options", [[], ["-fsanitize=address,undefined"]], ids=["plain", "sane"])
def test_the_example_is_compiled_without_a_warning_and_runs(place, tmp_path, options):
    out = exported("host", place)
    made = tmp_path / "example"
    subprocess.run(
        [COMPILER, *WARNINGS, *options, out / "example.c",
        *(out / name for name in FIRMWARE_C_FILES),
         out / "libeha.a", "-lm", "-o", made],
        check=True,
    )  # fmt: skip
    done = subprocess.run([made], capture_output=True, text=True, check=True)
    assert done.stdout == "alarms 0, spool 0 m, residual 0\n"


@pytest.mark.skipif(COMPILER is None or not shutil.which("pkg-config"), reason="no compiler here")
def test_the_shared_library_is_found_by_pkg_config(place, tmp_path):
    out = exported("host", place)
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "eha"],
        capture_output=True, text=True, check=True, env={"PKG_CONFIG_PATH": str(out)},
    ).stdout.split()  # fmt: skip
    made = tmp_path / "example"
    sources = (out / name for name in ("example.c", *FIRMWARE_C_FILES))
    subprocess.run([COMPILER, *sources, *flags, "-lm", "-o", made], check=True)
    done = subprocess.run(
        [made], capture_output=True, text=True, check=True, env={"LD_LIBRARY_PATH": str(out)}
    )
    assert done.stdout.startswith("alarms 0")


def test_the_page_says_what_memory_they_take():
    page = (ROOT / "docs" / "how-to" / "export.md").read_text()
    assert f"one `eha_monitor`\nof {8 * MONITOR_SIZE} bytes" in page
    thousands, rest = divmod(8 * ONBOARD.end, 1000)
    assert f"`eha_identification` of {thousands} {rest:03} bytes" in page


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cppcheck"), reason="no cppcheck here")
def test_cppcheck_finds_nothing(place):
    out, ours = exported("host", place), ROOT / "firmware_iface" / "c"
    rest = [path for path in ours.glob("*.c") if not (out / path.name).exists()]
    assert rest
    done = subprocess.run(
        ["cppcheck", "--std=c99", "--enable=warning,style,portability", "--error-exitcode=1",
         # A struct of FMI has members that a unit does not need.
         "--suppress=unusedStructMember", "--quiet", f"-I{out}",
         *out.glob("*.c"), *rest, ROOT / "ehadiag" / "data" / "export" / "fmu.c"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not shutil.which("cmake") or not shutil.which("cc"), reason="no CMake here")
def test_cmake_builds_the_export(place, tmp_path):
    for options in (["-S", exported("host", place), "-B", tmp_path], ["--build", tmp_path]):
        subprocess.run(["cmake", *options], check=True, capture_output=True)
    done = subprocess.run([tmp_path / "eha_example"], check=True, capture_output=True, text=True)
    assert done.stdout.startswith("alarms 0")


@of_targets
@pytest.mark.skipif(
    not shutil.which("cmake") or not shutil.which("arm-none-eabi-gcc"), reason="no CMake for Arm"
)
def test_cmake_builds_the_export_with_the_target_s_compiler(place, tmp_path):
    """Compiled and linked for the same calling convention."""
    toolchain = {
        "CMAKE_SYSTEM_NAME": "Generic",
        "CMAKE_C_COMPILER": "arm-none-eabi-gcc",
        "CMAKE_TRY_COMPILE_TARGET_TYPE": "STATIC_LIBRARY",
        "CMAKE_EXE_LINKER_FLAGS": "--specs=rdimon.specs",
    }
    of_target = [f"-D{name}={value}" for name, value in toolchain.items()]
    source = exported("cortex-m7", place)
    for options in (["-S", source, "-B", tmp_path, *of_target], ["--build", tmp_path]):
        subprocess.run(["cmake", *options], check=True, capture_output=True)
    assert (tmp_path / "eha_example").is_file()


def test_a_number_of_hours_that_no_threshold_gives(place):
    with pytest.raises(ConfigurationError, match="hours"):
        export_library(default_actuator(), find_target("host"), None, hours=1e9)


@of_targets
@pytest.mark.skipif(not shutil.which("arm-none-eabi-nm"), reason="no binutils for Arm here")
@pytest.mark.parametrize("name", ["cortex-m7", "cortex-m4", "cortex-m4-single", "cortex-r5"])
def test_arm_code_hands_numbers_to_nobody(name, place):
    """Either calling convention fits only functions of pointers, and those of the compiler."""
    told = subprocess.run(
        ["arm-none-eabi-nm", "--undefined-only", exported(name, place) / "libeha.a"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    called = {line.split()[-1] for line in told.splitlines() if line.split()[:1] == ["U"]}
    called = {item for item in called if not item.startswith("__aeabi_")}
    of_compiler = {"div", "mod", "udiv", "umod"}
    if name.startswith("cortex-m4"):  # doubles in software: by the compiler's own functions
        called = {item for item in called if not re.fullmatch(r"__\w+[sd]f\d?", item)}
    assert called <= {
        "memset", "memcpy", "__fixdfdi", "__floatdidf", "__floatundidf",
        "__fixsfdi", "__floatdisf", "__floatundisf",
        *(f"__{name}di3" for name in of_compiler),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cppcheck"), reason="no cppcheck here")
def test_every_deviation_from_misra_is_listed(place):
    out = exported("host", place)
    sources = [name for name in FIRMWARE_C_FILES if name != "eha_fcc.c"]
    done = subprocess.run(
        ["cppcheck", "--addon=misra", "--std=c99", "--enable=style", "--quiet", f"-I{out}",
         *(out / name for name in ("example.c", *sources))],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    found = set(re.findall(r"\[misra-c2012-([\d.]+)\]", done.stderr))
    if not found:
        pytest.skip("this cppcheck has no rules of MISRA")
    page = (ROOT / "docs" / "reference" / "misra.md").read_text()
    cells = [line.split("|")[1] for line in page.splitlines() if line.startswith("| ")]
    rules = {rule for cell in cells for rule in re.findall(r"\d+\.\d+", cell)}
    assert found <= rules
