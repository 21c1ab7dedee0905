"""A rig with another valve (40 mA, 0.8 mm spool) on a bus with ranges and steps of its own."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path

from ehadiag import Actuator, StoredTest
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.emulator import FccCore
from firmware_iface.bus_map import BusMap
from firmware_iface.codec import Encoder
from firmware_iface.transport.frames import Frame

STROKE = 0.381 / 0.8
DATA = {
    "IM": 40e-3,
    "GAP": 6.8,
    "GM": 2.82 / 4,
    "KSF": 74.3 * STROKE,
    "GP": 2e12 * STROKE,
    "GQ": 0.63 * STROKE,
    "AS": 1.677e-5 * STROKE,
    "CS": 2.0 * STROKE**2,
    "FSS0": 2.0 * STROKE,
    "FSS1": 60.0 * STROKE,
    "XSM": 0.8e-3,
}
"""The reference actuator with four times the current and twice the stroke of the spool."""
CONVERTERS = """
[converters]
current = { full_scale = 48e-3 }
spool = { full_scale = 1e-3 }
position = { full_scale = 60e-3, bits = 16 }
"""
JACK = """BO_ 274 JackTelemetry: 8 FCC
 SG_ JackPosition : 0|16@1- (0.0018310546875,0) [-60|59.9981689453125] "mm" TESTER
 SG_ JackCounter : 48|8@1+ (1,0) [0|255] "" TESTER
 SG_ JackCrc8 : 56|8@1+ (1,0) [0|255] "" TESTER

BO_ 273 ServoCommand"""
SIGNALS = {
    r"ServoCurrent : .*": 'ServoCurrent : 0|12@1+ (0.0234375,-48) [-48|47.9765625] "mA" TESTER',
    r"SpoolPosition : .*": 'SpoolPosition : 12|13@1+ (0.00025,-1) [-1|1.04775] "mm" TESTER',
    r"DiffPressure : .*": 'DiffPressure : 25|14@1- (0.5,0) [-4096|4095.5] "psi" TESTER',
    r"CurrentCommand : .*": 'CurrentCommand : 16|16@1- (0.01,0) [-327.68|327.67] "mA" TESTER',
    r"PositionCommand : .*": 'PositionCommand : 0|16@1- (0.005,0) [-163.84|163.835] "mm" TESTER',
}
"""Pressure and spool finer than their 12-bit converters, the commands coarser than the default."""


def packaged(package: str, name: str) -> str:
    """Text of a file that comes with a package."""
    return resources.files(package).joinpath("data", name).read_text(encoding="utf-8")


def write_rig(folder: Path, converters: str = CONVERTERS) -> Path:
    """Write actuator.toml, rig.dbc, rig.toml and open-40.toml; return the folder."""
    text = packaged("ehadiag", "actuator.toml")
    for key, value in DATA.items():
        text, count = re.subn(rf"(?m)^{key}\s*=\s*\S+", f"{key} = {value!r}", text)
        assert count == 1
    (folder / "actuator.toml").write_text(text + converters, encoding="utf-8")
    dbc = packaged("firmware_iface", "eha_fcc.dbc")
    for pattern, line in SIGNALS.items():
        dbc, count = re.subn(pattern, line, dbc)
        assert count == 1
    dbc = re.sub(r" SG_ JackPosition .*\n", "", dbc).replace("BO_ 273 ServoCommand", JACK)
    (folder / "rig.dbc").write_text(dbc, encoding="utf-8")
    mapping = packaged("firmware_iface", "eha_fcc.toml").replace("eha_fcc.dbc", "rig.dbc")
    mapping = mapping.replace('position = { message = "ServoT', 'position = { message = "JackT')
    mapping += '[protection.JackTelemetry]\ncounter = "JackCounter"\ncounts = "ticks"\n'
    mapping += 'crc = "JackCrc8"\n'
    (folder / "rig.toml").write_text(mapping, encoding="utf-8")
    test = packaged("firmware_iface", "tests/open.toml").replace('"open"', '"open-40"')
    test = re.sub(r"(?m)^id = 1$", "id = 41", test)
    head, tail = test.split("[windows]")
    for low, high in (("1.5]", "6.0]"), ("10.0]", "40.0]"), ("= 3.0\nf", "= 12.0\nf")):
        head = head.replace(low, high)
    head = head.replace("amplitude = 8.0", "amplitude = 32.0")
    (folder / "open-40.toml").write_text(f"{head}[windows]{tail}", encoding="utf-8")
    return folder


def frames_of_a_test(
    actuator: Actuator,
    tests: Iterable[StoredTest],
    bus: BusMap,
    number: int,
    *,
    faults: Faults | None = None,
    effects: Effects | None = None,
) -> Iterator[Frame]:
    """Frames of the emulated computer, idle, then through one test that is asked for."""
    core = FccCore(
        actuator, tests, faults=faults, effects=effects, seed=5, serial=7, bus_map=bus,
        start_ns=1_700_000_000_000_000_000,
    )  # fmt: skip
    for _ in range(50):
        yield from core.step()
    request = Encoder(bus).request("start", number, core.now_ns)
    yield from request
    for frame in request:
        core.take(frame)
    started = False
    while core.state.name != "IDLE" or not started:
        yield from core.step()
        started = True
