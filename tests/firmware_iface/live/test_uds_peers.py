"""UDS against other people's programs, each in a process of its own on udp_multicast."""

from __future__ import annotations

import json
import os
import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import odxtools
import pytest
from places import ROOT

from ehadiag.cli.main import main

LOOPNET = str(ROOT / "tools" / "loopnet.sh")
NO_NAMESPACE = 125
ATTEMPTS = 4
STARVED = re.compile(r"telemetry lost|no answer within|not complete 1 s|timed? ?out|TimeoutExc")
"""What either end says where the other one did not get the processor in time."""
HERE = Path(__file__).parent
SIM_AND_TESTER = """
"$PYTHON" -m ehadiag sim --interface udp_multicast --protocol uds "$@" 2> sim.err &
sim=$!
until grep -q 'Ctrl-C stops it' sim.err; do
    kill -0 $sim || { cat sim.err >&2; exit 99; }
    sleep 0.05
done
"$PYTHON" "$TESTER" 2 found.json
code=$?
kill -TERM $sim
wait $sim
cat sim.err >&2
exit $code
"""
COMPUTER_AND_CLIENT = """
"$PYTHON" "$COMPUTER" "$LOG" requests.json > ready &
until grep -q ready ready; do sleep 0.05; done
"$PYTHON" -c "$CLIENT"
code=$?
wait
exit $code
"""
CLIENT = """
import json, msgspec
from firmware_iface.tester import run_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.python_can import PythonCanTransport
with PythonCanTransport(BusOptions("udp_multicast"), transmit=True) as bus:
    found = run_test(bus, test_id=2, duration=0.4, transmit=True, protocol="uds", onboard_wait=20)
print(json.dumps(msgspec.to_builtins(found), default=str))
"""


def run(
    script: str, folder: Path, *options: str, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run both ends; once more where one of them did not get the processor."""

    for _ in range(ATTEMPTS):
        done = subprocess.run(
            [LOOPNET, "sh", "-c", script, "ends", *options],
            cwd=folder,
            env=os.environ
            | {"PYTHON": sys.executable, "PYTHONPATH": f"{ROOT}:{ROOT / 'sim'}"}
            | variables,
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
        if not STARVED.search(done.stdout + done.stderr):
            break
    if done.returncode == NO_NAMESPACE:
        pytest.skip(f"no network namespace: {done.stderr.strip()}")
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("tester")
    options = (
        "--Kintas=0.3",
        "--FSS=0.8",
        "--FDJ=0.1",
        "--unit=4711",
        "--offsets",
        "3",
        "0",
        "-2",
        "0",
    )
    run(SIM_AND_TESTER, folder, *options, TESTER=str(HERE / "uds_tester.py"))
    answer: dict[str, Any] = json.loads((folder / "found.json").read_text())
    return answer


def test_a_foreign_tester_runs_a_test_and_stops_one(found: dict[str, Any]) -> None:
    refusals = {
        "results before": 0x24,
        "stop before": 0x24,
        "unknown test": 0x31,
        "unknown routine": 0x31,
        "no option": 0x13,
        "reset": 0x11,
        "busy": 0x21,
        "unknown data": 0x31,
    }
    assert {name: found[name] for name in refusals} == refusals
    states = [answer[0] for answer in found["answers"]]
    assert states == sorted(states)
    assert set(states) >= {2, 3}
    assert {answer[2] for answer in found["answers"]} == {2}
    assert {answer[4] for answer in found["answers"]} == {4711}
    elapsed = [answer[3] for answer in found["answers"]]
    assert elapsed == sorted(elapsed)
    assert elapsed[-1] == 5500
    assert (found["stopped"], found["after"]) == (4, 4)
    assert found["telemetry"] > 1000  # of 5500: a busy listener misses some
    assert {0x7E0, 0x7E8} <= {*found["identifiers"]}
    assert not {0x200, 0x201} & {*found["identifiers"]}
    assert found["lengths"] == [8]


def test_it_reads_what_the_unit_has(found: dict[str, Any]) -> None:
    assert bytes.fromhex(found["f195"]).rstrip(b"\0").startswith(b"ehadiag ")
    assert bytes.fromhex(found["f18c"]) == struct.pack(">H", 4711)
    offsets = struct.unpack(">hhhh", bytes.fromhex(found["0121"]))
    scale = (5e-4, 2e-5, 1e-3, 2e-3)
    lsb = (12 / 2048, 0.5 / 2048, 25 / 2048, 60 / 2048)
    assert [number * size for number, size in zip(offsets, scale, strict=True)] == pytest.approx(
        [count * size for count, size in zip((3, 0, -2, 0), lsb, strict=True)], abs=1e-3
    )
    onboard = bytes.fromhex(found["0120"])
    assert struct.unpack(">BBBH", onboard[:5]) == (3, 2, 20, 0)
    numbers = [int.from_bytes(onboard[at : at + 3], "big") for at in range(5, 23, 3)]
    assert numbers == [3_000_000, 8_000_000, 1_000_000, 10_000, 10_000, 10_000]
    assert found["codes"] == [[0x5A0200, 0x09]]
    assert found["codes after"] == [[0x5A0300, 0x09]]
    assert found["snapshot"] == [0x0120, found["0120"]]
    assert found["supported"] == 3


def test_odxtools_knows_every_message_of_it(found: dict[str, Any], tmp_path: Path) -> None:
    assert main(["export", "--pdx", str(tmp_path / "fcc.pdx")]) == 0
    database = odxtools.load_pdx_file(tmp_path / "fcc.pdx")  # its parts know it weakly
    ecu = database.ecus.FlightControlComputer
    request, seen = b"", set()
    for kind, text in found["messages"]:
        message = bytes.fromhex(text)
        if kind == "request":
            request = message
            continue
        if message[0] == 0x7F and message[2] in (0x11, 0x13, 0x31):
            continue  # to requests that are none of the description
        (read,) = ecu.decode_response(message, request)
        seen.add(read.coding_object.short_name)
        assert bytes(read.coding_object.encode(request, **read.param_dict)) == message
        (asked,) = ecu.decode(request)
        assert bytes(asked.coding_object.encode(**asked.param_dict)) == request
        if read.coding_object.short_name == "Read_OnboardResult_Response":
            assert read.param_dict["FSS"] == pytest.approx(0.8)
            assert read.param_dict["verdict"] == "FAULT"
    positive = {item.positive_responses[0].short_name for item in ecu.services}
    assert seen == positive | {"NegativeResponse"}


def test_the_own_tester_runs_a_test_of_a_foreign_computer(tmp_path: Path) -> None:
    log = ROOT / "tests" / "data" / "logs" / "healthy-closed.blf"
    done = run(
        COMPUTER_AND_CLIENT,
        tmp_path,
        COMPUTER=str(HERE / "uds_computer.py"),
        LOG=str(log),
        CLIENT=CLIENT,
    )
    outcome = json.loads(done.stdout)
    assert outcome["why"] == ""
    assert outcome["complete"]
    assert outcome["serial"] == 4711
    onboard = outcome["onboard"]
    assert (onboard["test_id"], onboard["verdict"], onboard["runs"]) == (2, 10, 321)
    assert onboard["severities"] == pytest.approx({"Kintas": 0.1, "FSS": 0.2, "FDJ": 0.3}, abs=1e-6)
    assert onboard["std"] == pytest.approx({"Kintas": 0.01, "FSS": 0.02, "FDJ": 0.03}, abs=1e-6)
    assert outcome["notes"] == [
        "flight-control computer: serial 4711; software rig 7; trouble codes C1A01-00 DEGRADED"
    ]
    asked = json.loads((tmp_path / "requests.json").read_text())
    assert asked.count("3101020102") == 1
    assert asked.count("220120") >= 3
    assert "31020201" not in asked
    assert {item[:4] for item in asked} == {"3101", "3103", "2201", "22f1", "1902"}
