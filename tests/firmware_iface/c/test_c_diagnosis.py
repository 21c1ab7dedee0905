"""The node that diagnoses itself: with a stand-in for the library, then with the exported one."""

import ctypes
import json
import math
import shutil
import subprocess

import c_side
import numpy as np
import pytest
from exported import exported
from live_ends import LOADED_MACHINE, cable
from msgspec.structs import replace
from onboard_frames import DATABASE
from onboard_node import bare_node, build_bare_node, build_node, write_played
from places import LOGS

from ehadiag import diagnose
from ehadiag.cli.main import main
from ehadiag_tools.onboard.replay import EMULATED, identified, missing, surrounded, ticks_of
from firmware_iface import tester
from firmware_iface.recording import OnboardState
from firmware_iface.signals.recordings import read_recording
from firmware_iface.transport.frames import Frame

NOTHING, RECORDING, IDENTIFYING, DONE, GIVEN_UP = OnboardState
TICKS = 5500
NOT_TESTED = 30.0
STAND_IN = r"""
#include "diagnosis.h"
static struct fcc_node node;
static struct fcc_diagnosis diagnosis;
static double runs_asked, seen_ticks;
static eha_tick first;
static int begin_status, runs_needed;

int32_t eha_unit_environment(eha_unit *unit, const eha_environment *around)
{
    unit->viscosity = around->oil_temperature;
    unit->supply = around->supply_pressure - around->return_pressure;
    return 0;
}

int32_t eha_identify_begin(eha_identification *job, const eha_unit *unit)
{
    job->runs = 0.0;
    job->own[0] = unit->viscosity;
    job->own[1] = unit->supply;
    job->own[2] = unit->closed;
    return begin_status;
}

int32_t eha_identify_run(eha_identification *job, const eha_tick *recording,
                         const eha_slice *slice)
{
    job->runs += slice->work;
    runs_asked = slice->work;
    seen_ticks = slice->ticks;
    first = recording[0];
    job->kintas = 0.25;
    job->std_kintas = 2.0;
    job->fss = 1.0;
    job->fdj = -1e-9;
    job->verdict = EHA_DEGRADED;
    return job->runs >= runs_needed ? EHA_IDENTIFY_DONE : EHA_IDENTIFY_GOES_ON;
}

void start(int status, int runs)
{
    const struct fcc_rig rig = {2070, 70, 1400, false};

    begin_status = status;
    runs_needed = runs;
    fcc_node_init(&node, 7, &rig);
    fcc_diagnosis_init(&diagnosis);
}

void ask(uint8_t code, uint8_t test_id)
{
    struct fcc_frame frame;
    uint8_t counter = 0;

    fcc_pack_request(&frame, code, test_id, &counter);
    fcc_node_take(&node, &frame);
}

size_t tick(struct fcc_frame *frames)
{
    const uint16_t codes[4] = {2048, 2049, 2050, 2048};
    struct fcc_frame others[FCC_FRAMES_PER_TICK];

    (void)fcc_node_begin(&node);
    (void)fcc_node_end(&node, codes, others);
    return fcc_diagnosis_tick(&diagnosis, &node, codes, frames);
}

int work(void) { return fcc_diagnosis_work(&diagnosis, 1.0) ? 1 : 0; }
int stage(void) { return diagnosis.stage; }
void told(double out[6])
{
    out[0] = diagnosis.job.own[0];
    out[1] = diagnosis.job.own[1];
    out[2] = diagnosis.job.own[2];
    out[3] = seen_ticks;
    out[4] = first.spool;
    out[5] = first.pressure;
}
"""


class Node:
    """A node with a stand-in for the library, tick by tick."""

    def __init__(self, path):
        self._c = ctypes.CDLL(str(path))
        self._c.tick.restype = ctypes.c_size_t
        self.start()

    def start(self, status=0, runs=3):
        self._c.start(status, runs)
        self.frames = []

    def ask(self, test_id):
        self._c.ask(1, test_id)

    def abort(self):
        self._c.ask(2, 1)

    def run(self, ticks):
        frames = (c_side.CFrame * 4)()
        for _ in range(ticks):
            self.frames += [frames[i].content for i in range(self._c.tick(frames))]

    def work(self):
        return bool(self._c.work())

    @property
    def stage(self):
        return self._c.stage()

    @property
    def told(self):
        out = (ctypes.c_double * 6)()
        self._c.told(out)
        return list(out)

    @property
    def last(self):
        """Content of the last frame of each message."""
        return {
            DATABASE.get_message_by_frame_id(number).name: DATABASE.decode_message(
                number, data, decode_choices=False
            )
            for number, data in self.frames
        }


FILLED_IN = {
    "supply": "2e7", "before": "1", "behind": "1", "own": "3",
    "library": "2000.0", "plan": "1.0", "serial": "0.0",
    "severities": "double kintas; double fss; double fdj;", "zeros": "0.0, 0.0, 0.0",
}  # fmt: skip


@pytest.fixture(scope="module")
def library(c_build, tmp_path_factory):
    work = tmp_path_factory.mktemp("stand-in")
    folder = c_side.SOURCES.parents[1] / "ehadiag" / "data" / "export"
    for name in ("eha_monitor", "eha_identify"):
        text = (folder / f"{name}.h.in").read_text()
        for key, value in FILLED_IN.items():
            text = text.replace(f"${key}", value)
        (work / f"{name}.h").write_text(text)
    (work / "stand_in.c").write_text(STAND_IN)
    names = ("diagnosis", "samples", "check", "frames", "node", "stored_tests", "generated/eha_fcc")
    made = work / "libstand.so"
    subprocess.run(
        ["cc", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fPIC", "-shared",
         f"-I{work}", f"-I{c_side.SOURCES}", *(c_side.SOURCES / f"{n}.c" for n in names),
         work / "stand_in.c", "-lm", "-o", made],
        check=True,
    )  # fmt: skip
    return made


@pytest.fixture
def node(library):
    return Node(library)


def test_a_whole_test_is_recorded_identified_and_told(node):
    node.ask(1)
    node.run(50)
    assert node.stage == NOTHING
    node.run(200)
    assert node.stage == RECORDING
    assert node.last["OnboardVerdict"]["OnboardState"] == RECORDING
    node.run(TICKS)
    assert node.stage == IDENTIFYING
    while node.work():
        node.run(7)
    assert node.stage == DONE
    assert node.told == [40.0, 20e6, 0.0, TICKS, pytest.approx(0.25e-6, rel=0.03), 2 * 25e6 / 2048]
    node.run(200)
    last = node.last
    assert last["OnboardVerdict"]["OnboardVerdict"] == 10
    assert last["OnboardVerdict"]["OnboardTestId"] == 1
    assert last["OnboardVerdict"]["OnboardRuns"] == 3
    assert last["OnboardKintas"]["SeverityKintas"] == pytest.approx(0.25, abs=1e-9)
    assert last["OnboardKintas"]["DeviationKintas"] == pytest.approx(1.6777215, abs=1e-9), "cut"
    assert last["OnboardFSS"]["SeverityFSS"] == pytest.approx(1.0, abs=1e-9)
    assert last["OnboardFDJ"]["SeverityFDJ"] == 0.0


def test_a_test_in_closed_loop_is_told_to_be_one(node):
    node.ask(2)
    node.run(TICKS + 200)
    assert node.work()
    assert node.told[2] == 1.0


def test_an_aborted_test_is_given_up(node):
    node.ask(1)
    node.run(400)
    node.abort()
    node.run(200)
    assert node.stage == GIVEN_UP
    assert not node.work()
    assert node.last["OnboardVerdict"]["OnboardState"] == GIVEN_UP
    assert set(node.last) == {"OnboardVerdict"}


def test_numbers_out_of_their_range_are_given_up(node):
    node.start(status=1)
    node.ask(1)
    node.run(TICKS + 200)
    assert node.work()
    assert node.stage == GIVEN_UP


def test_a_second_test_ends_the_identification_of_the_first(node):
    node.start(runs=1000)
    node.ask(1)
    node.run(TICKS + 200)
    assert node.work()
    node.ask(2)
    node.run(20)
    assert not node.work()
    assert node.stage == NOTHING
    node.run(TICKS + 200)
    assert node.stage == IDENTIFYING
    assert node.work()
    assert node.told[2] == 1.0


def test_a_background_that_does_not_give_way_keeps_its_recording(node):
    node.start(runs=1000)
    node.ask(1)
    node.run(TICKS + 200)
    assert node.work()
    node.ask(2)
    node.run(1000)
    assert node.stage == IDENTIFYING
    assert not node.work()
    node.run(TICKS)
    assert node.stage == NOTHING, "the second test was not recorded from its start"


def test_the_counters_and_check_sums_are_those_of_the_bus(node, library):
    node.ask(1)
    node.run(1000)
    seen = [data[6] for number, data in node.frames if number == 0x210]
    assert seen == list(range(len(seen)))
    for number, data in node.frames:
        frame = c_side.c_frame(Frame(0, number, data))
        assert ctypes.CDLL(str(library)).fcc_intact(ctypes.byref(frame)) & 0xFF == 1


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("node")


def told_by(line, out):
    """The `onboard` object that `ehadiag bit` gives of a node on a line."""
    command = ["bit", "--test", "open", "--port", line, "--out", str(out), "--no-picture",
               "--onboard-wait", "120"]  # fmt: skip
    assert main(command) == 10
    (path,) = out.glob("*.json")
    (recording,) = out.glob("*.blf")
    return json.loads(path.read_text()), read_recording(recording)


def check(told, heard, expected):
    """What the bus carries is the outcome, rounded; what was heard is what the log holds."""
    (recording,) = told["recordings"]
    assert told["quality"]["lost"] == 0
    onboard = recording["onboard"]
    for name, value in heard.onboard.severities.items():
        if expected.verdict == NOT_TESTED:
            assert math.isnan(getattr(expected, name))
            assert math.isnan(value)
            assert onboard["faults"][name] == {"estimate": None, "std": None}
            continue
        assert onboard["faults"][name] == {"estimate": value, "std": heard.onboard.std[name]}
        assert round(value * 1e7) == int(getattr(expected, name) * 1e7 + 0.5)
        std = getattr(expected, f"std_{name}")
        assert round(heard.onboard.std[name] * 1e7) == int(min(std, 1.6777215) * 1e7 + 0.5)
    assert onboard["evaluations"] == int(expected.runs)


@pytest.mark.slow
@pytest.mark.xdist_group("exports")  # of which another test compiles the library
@pytest.mark.parametrize(("target", "ticks"), [("host", TICKS), ("cortex-m7", 400)])
def test_what_the_node_tells_is_what_the_library_finds_here(
    target, ticks, place, tmp_path, monkeypatch
):
    monkeypatch.setattr(tester, "TimeLimits", lambda: LOADED_MACHINE)
    emulator = next(item for item in EMULATED if item.target == target)
    absent = [*missing(emulator), *missing(EMULATED[0])]
    if absent or not shutil.which("make"):
        pytest.skip(f"not installed: {', '.join(absent) or 'make'}")
    write_played(read_recording(LOGS / "paper-open-1.blf"), tmp_path)
    option, out = f"-DFCC_DIAGNOSIS_TICKS={ticks}u", tmp_path / "out"
    short = 0 if ticks == TICKS else ticks
    bits = None
    if target == "host":
        program = build_node(
            exported("host", place), tmp_path, option, "-fsanitize=address,undefined"
        )
        refused = subprocess.run([program, "none", "--uds"], capture_output=True, check=False)
        assert (refused.returncode, b"--uds: " in refused.stderr) == (2, True)
        with cable() as (here, there), subprocess.Popen([program, there, "--serial", "1"]) as node:
            try:
                told, heard = told_by(here, out)
            finally:
                node.terminate()
    else:
        with bare_node(build_bare_node(exported(target, place, short), tmp_path, option)) as node:
            told, heard = told_by(node.line, out)
            bits = node.found
    library, recorded = exported("host", place, short), ticks_of(heard)[:ticks]
    found = identified(EMULATED[0], library, surrounded(heard), recorded, tmp_path).outcome
    check(told, heard, found)
    if ticks == TICKS:
        # The package estimates oil and supply within the bus's steps; the board holds them, and so
        # does the package here: 0.22 deviations of FDJ are left.
        around = replace(heard.environment, temperature_std=0.0, supply_std=0.0)
        for name, own in diagnose(replace(heard, environment=around)).severities.items():
            assert abs(getattr(found, name) - own.value) < 0.8 * own.std
    if bits is not None:
        assert np.array(found[: len(bits)]).tobytes() == np.array(bits).tobytes()
