"""Changes of a simulated unit while it runs: at once, along ramps, by script and control port."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ehadiag import ConfigurationError, bundled_tests, default_actuator
from ehadiag_sim.conditions import Faults
from ehadiag_sim.control import (
    LOOPBACK,
    MAX_LINE_BYTES,
    Change,
    SimulatorControl,
    control_port,
    read_script,
)
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.tester import run_test
from firmware_iface.transport.frames import Frame, FrameTable

TESTS = bundled_tests()


def core_with(control: SimulatorControl, **options: Any) -> FccCore:
    return FccCore(default_actuator(), list(TESTS.values()), control=control, **options)


def recording_of(control: SimulatorControl, **options: Any) -> Any:
    frames: list[Frame] = []
    transport = EmulatorTransport(core_with(control, **options))
    outcome = run_test(
        transport, test_id=1, duration=5.5, transmit=True, bus_map=default_map(),
        on_frame=frames.append,
    )  # fmt: skip
    return outcome, assemble(FrameTable.from_frames(frames), default_map(), "here")[0]


def test_without_a_change_nothing_changes() -> None:
    core, other = core_with(SimulatorControl()), FccCore(default_actuator(), list(TESTS.values()))
    assert [core.step() for _ in range(300)] == [other.step() for _ in range(300)]


def test_a_severity_changes_at_once_and_stays_in_the_next_test() -> None:
    control = SimulatorControl()
    core = core_with(control)
    control.apply(Change(set={"FSS": 0.5, "supply": 18.0}))
    core.step()
    assert control.state()["FSS"] == 0.5
    assert core.plant.probed[0] == pytest.approx(18e6)


def test_a_worn_unit_is_that_of_its_options() -> None:
    """A change before the test gives the digits of a unit that began with it."""
    control = SimulatorControl()
    control.apply(Change(set={"FDJ": 0.4, "null_bias_mA": 0.1}))
    _, changed = recording_of(control)
    _, began = recording_of(SimulatorControl([Change(set={"null_bias_mA": 0.1})]),
                            faults=Faults(FDJ=0.4))  # fmt: skip
    np.testing.assert_array_equal(changed.samples.spool, began.samples.spool)
    np.testing.assert_array_equal(changed.samples.position, began.samples.position)


def test_a_ramp_goes_from_the_present_value() -> None:
    control = SimulatorControl([Change(set={"FSS": 0.2}), Change(set={"FSS": 0.8}, ramp_s=1.0)])
    core, seen = core_with(control), []
    for _ in range(1500):
        core.step()
        seen.append(control.state()["FSS"])
    assert seen == sorted(seen)
    assert seen[500] == pytest.approx(0.5, abs=0.02)
    assert seen[-1] == pytest.approx(0.8)


def test_a_script_keeps_its_times(tmp_path: Path) -> None:
    path = tmp_path / "wear.toml"
    path.write_text(
        "[[change]]\nat_s = 0.2\nset = { FDJ = 0.3 }\n"
        "[[change]]\nat_s = 0.1\nset = { offsets = [0, 5, 0, 0] }\n"
    )
    control = SimulatorControl(read_script(path))
    core, changed = core_with(control), {}
    for tick in range(300):
        core.step()
        for key, value in control.state().items():
            if key in ("FDJ", "offsets") and np.any(value):
                changed.setdefault(key, tick)
    assert changed == {"offsets": 100, "FDJ": 200}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[[change]]\nset = { FFS = 0.3 }", "there is no key FFS, did you mean FSS?"),
        ("[[change]]\nset = { FSS = 1.3 }", "1.3 is outside 0 … 1"),
        ("[[change]]\nset = { frames_lost = 2 }", "frames_lost: 2 is outside 0 … 1"),
        ("[[change]]\nset = { FSS = 0.3 }\nramp_s = -1", "ramp_s: -1 is outside"),
        ("[[change]]\nset = { offsets = 3 }", "offsets: 3.0: need 4 numbers"),
        ("[[change]]\nset = { FSS = [0.1, 0.2] }", "need a number"),
        ("[[change]]\nset = { supply = 0.5 }", "supply pressure must be greater"),
        ("[[change]]\nramp_s = 1", "missing required field `set`"),
        ("change = 1", "Expected `array`"),
    ],
)
def test_a_bad_script_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_script(path)
    assert reason in str(caught.value)
    assert "bad.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ({"frames_lost": 0.02}, "lost"),
        ({"frames_damaged": 0.02}, "crc_errors"),
        ({"frames_doubled": 0.02}, "repeated"),
    ],
)
def test_damage_to_frames_is_counted(values: dict[str, float], kind: str) -> None:
    _, recording = recording_of(SimulatorControl([Change(set=values)], seed=3))
    found = recording.quality.total(kind)
    assert 100 < found < 400


def test_a_second_sender_is_a_conflict() -> None:
    _, recording = recording_of(SimulatorControl([Change(set={"second_sender": 0.5})], seed=3))
    assert recording.quality.refused


def test_a_bus_off_loses_the_test() -> None:
    control = SimulatorControl([Change(set={"bus_off_s": 0.5}, at_s=2.0)])
    outcome, _ = recording_of(control)
    assert outcome.why.startswith("telemetry lost")


class TestControlPort:
    @staticmethod
    def ask(port: int, *lines: bytes) -> list[dict[str, Any]]:
        with socket.create_connection((LOOPBACK, port), timeout=20.0) as link:
            link.sendall(b"".join(line + b"\n" for line in lines))
            with link.makefile("rb") as answers:
                return [json.loads(answers.readline()) for _ in lines]

    def test_requests_are_answered_in_order(self) -> None:
        control = SimulatorControl()
        core = core_with(control)
        with control_port(control, 0) as port:
            answers = self.ask(
                port,
                b'{"set": {"FSS": 0.4}}',
                b'{"set": {"filter_ms": 0.1}}',
                b'{"set": {"FFS": 0.4}}',
                b'{"sets": {}}',
                b"not json",
            )
            core.step()
            (values,) = self.ask(port, b'{"get": true}')
        assert answers[:2] == [{"ok": True}, {"ok": True, "from_next_test": ["filter_ms"]}]
        assert answers[2] == {"error": "change: there is no key FFS, did you mean FSS?"}
        assert all("error" in answer for answer in answers[3:])
        assert values["FSS"] == 0.4
        assert values["time_s"] == 0.001

    def test_a_line_without_end_is_refused(self) -> None:
        with control_port(SimulatorControl(), 0) as port:
            (answer,) = self.ask(port, b"[" * (MAX_LINE_BYTES + 10))
            assert str(MAX_LINE_BYTES) in answer["error"]
            assert self.ask(port, b'{"get": true}')[0]["FSS"] == 0.0

    def test_a_port_in_use_is_named(self) -> None:
        with (
            control_port(SimulatorControl(), 0) as port,
            pytest.raises(ConfigurationError, match=f"control port {port}: .*choose another"),
            control_port(SimulatorControl(), port),
        ):
            pass
