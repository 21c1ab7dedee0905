"""Exported libraries: the package's own monitor here, and the same digits in every emulator."""

import hashlib
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from exported import Loaded, exported, object_of
from places import LOGS, ROOT

from ehadiag.core.actuator import default_actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.export.firmware import SOURCES
from ehadiag.export.library import export_library
from ehadiag.export.targets import TARGETS, target
from ehadiag.monitor import Monitor
from ehadiag.monitor.layout import CUSUM, PREDICTED, SIZE
from ehadiag.onboard.layout import SIZE as IDENTIFICATION
from ehadiag_tools.onboard.emulators import EMULATED, missing
from ehadiag_tools.onboard.replay import identified, replayed, ticks_of, unit_of
from ehadiag_tools.onboard.table import REFERENCE
from firmware_iface.logs.reader import read_recording

SEVERITIES = (0.3, 0.4, 0.2)
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
COMPILER = shutil.which("cc")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("exports")


@pytest.fixture(scope="module")
def loaded(place):
    return Loaded(object_of((exported("host", place) / "libeha.a").read_bytes()))


def started(loaded, unit, numbers):
    start = np.array(unit, dtype=np.float64)
    return loaded.function("eha_monitor_init", 2)(numbers.ctypes.data, start.ctypes.data)


@pytest.mark.parametrize("log", ["paper-closed-1.blf", "lossy-open.blf"])
def test_the_host_is_the_monitor_of_the_package(loaded, log):
    """To last digits: exported, each product and each sum is rounded by itself."""
    recording = read_recording(LOGS / log)
    ticks = ticks_of(recording)
    monitor = Monitor(
        default_actuator(), SEVERITIES, recording.environment, mode=recording.samples.mode
    )
    numbers = np.zeros(SIZE)
    assert started(loaded, unit_of(recording, SEVERITIES), numbers) == 0
    push = loaded.function("eha_monitor_push", 2)
    seen = numbers[PREDICTED : CUSUM + 4]
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
    numbers = np.full(SIZE, 3.0)
    assert started(loaded, unit, numbers) == 1
    assert (numbers == 3.0).all()


@pytest.mark.parametrize(("index", "wrong"), [(0, -0.01), (1, 1.01), (5, 0.0), (6, -1.0)])
def test_a_number_out_of_its_range_is_refused(loaded, index, wrong):
    unit = [0.1, 0.1, 0.1, 0.0, 0.0, 1.0, 20e6, 0.0]
    unit[index] = wrong
    assert started(loaded, unit, np.zeros(SIZE)) == 1


def test_reset_begins_anew(loaded):
    unit = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 20e6, 0.0]
    one, two = np.zeros(SIZE), np.zeros(SIZE)
    push, reset = (
        loaded.function("eha_monitor_push", 2),
        loaded.function("eha_monitor_reset", 2),
    )
    tick, spool = np.array([5e-3, 5e-3, 1e-5, 1e5, 0.0]), np.array([2e-5])
    for numbers in (one, two):
        assert started(loaded, unit, numbers) == 0
    for _ in range(40):
        push(one.ctypes.data, tick.ctypes.data)
    for numbers in (one, two):
        reset(numbers.ctypes.data, spool.ctypes.data)
        push(numbers.ctypes.data, tick.ctypes.data)
    assert one[:CUSUM].tobytes() == two[:CUSUM].tobytes()


def test_the_manifest_tells_what_was_written(place):
    out = exported("host", place)
    told = json.loads((out / "manifest.json").read_text())
    assert told["target"] == "host"
    for name, facts in told["files"].items():
        content = (out / name).read_bytes()
        assert facts == {
            "bytes": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
        }


def test_an_unknown_target_is_named():
    with pytest.raises(ConfigurationError, match="'pdp11': need one of host"):
        target("pdp11")


def test_every_target_can_be_emulated():
    assert [item.target for item in EMULATED] == [item.name for item in TARGETS]


@pytest.mark.slow
@pytest.mark.parametrize("emulator", EMULATED, ids=lambda item: item.target)
def test_a_target_has_the_digits_of_the_host(emulator, place, tmp_path):
    absent = missing(emulator)
    if absent:
        pytest.skip(f"not installed: {', '.join(absent)}")
    recording = read_recording(LOGS / "paper-closed-1.blf")
    ticks, unit = ticks_of(recording)[:600], unit_of(recording, SEVERITIES)
    name = REFERENCE[target(emulator.target).processor.single]
    host = next(item for item in EMULATED if item.target == name)
    expected = replayed(host, exported(name, place), unit, ticks, tmp_path).lines
    replay = replayed(emulator, exported(emulator.target, place), unit, ticks, tmp_path)
    assert replay.lines == expected
    assert 0 < replay.push_stack <= 2560
    assert 0 < replay.init_stack <= 2048


@pytest.mark.slow
def test_the_identification_has_the_digits_of_the_host_on_a_bare_target(place, tmp_path):
    host, bare = (
        next(item for item in EMULATED if item.target == name) for name in ("host", "cortex-m7")
    )
    absent = missing(host) + missing(bare)
    if absent:
        pytest.skip(f"not installed: {', '.join(absent)}")
    recording = read_recording(LOGS / "paper-open-1.blf")
    ticks, unit = ticks_of(recording)[:150], unit_of(recording, (0.0, 0.0, 0.0))
    expected = identified(host, exported("host", place), unit, ticks, tmp_path)
    assert expected.bits.startswith("0 ")
    found = identified(bare, exported("cortex-m7", place), unit, ticks, tmp_path)
    assert found.bits == expected.bits
    assert 0 < found.stack <= 4096
    assert found.millions > 0


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
@pytest.mark.parametrize("options", [[], ["-fsanitize=address,undefined"]], ids=["plain", "sane"])
def test_the_example_is_compiled_without_a_warning_and_runs(place, tmp_path, options):
    out = exported("host", place)
    made = tmp_path / "example"
    subprocess.run(
        [COMPILER, *WARNINGS, *options, out / "example.c", *(out / name for name in SOURCES),
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
    sources = (out / name for name in ("example.c", *SOURCES))
    subprocess.run([COMPILER, *sources, *flags, "-lm", "-o", made], check=True)
    done = subprocess.run(
        [made], capture_output=True, text=True, check=True, env={"LD_LIBRARY_PATH": str(out)}
    )
    assert done.stdout.startswith("alarms 0")


def test_the_page_says_what_memory_they_take():
    page = (ROOT / "docs" / "how-to" / "export.md").read_text()
    assert f"one `eha_monitor`\nof {8 * SIZE} bytes" in page
    thousands, rest = divmod(8 * IDENTIFICATION, 1000)
    assert f"`eha_identification` of {thousands} {rest:03} bytes" in page


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cppcheck"), reason="no cppcheck here")
def test_cppcheck_finds_nothing(place):
    out, ours = exported("host", place), ROOT / "firmware_iface" / "c"
    rest = [path for path in ours.glob("*.c") if not (out / path.name).exists()]
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


@pytest.mark.slow
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
        export_library(default_actuator(), target("host"), None, hours=1e9)


@pytest.mark.slow
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
    sources = [name for name in SOURCES if name != "eha_fcc.c"]
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
