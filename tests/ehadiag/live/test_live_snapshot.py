import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.live.snapshot import (
    Alarm,
    Bus,
    Ending,
    Residuals,
    RunningTest,
    Severity,
    Signals,
    Snapshot,
    known,
)


def full(text: str = "left aileron") -> Snapshot:
    values = (1.0, None, 3.0)
    return Snapshot(
        number=7,
        time="2026-03-01T12:00:00.000Z",
        command="bit",
        actuator=text,
        serial=12,
        bus=Bus(name=text, state="open", frames=4000, rate_per_s=2070.0, load=0.23, lost=1),
        test=RunningTest(name=text, number=1, phase="running", elapsed_s=2.0, duration_s=5.5),
        mode="position",
        signals=Signals(
            time_s=(0.0, 0.05, 0.1),
            command_mA=(None, None, None),
            command_mm=values,
            current_mA=values,
            spool_mm=values,
            pressure_MPa=values,
            position_mm=values,
        ),
        residuals=Residuals(spool=0.1, pressure=None, spool_above=0.5),
        alarms=(Alarm(time="2026-03-01T12:00:00.000Z", signal="spool", side="above"),),
        alarm_count=1,
        severities=(Severity(name="FSS", estimate=0.3, std=0.01, source=text),),
        ending=Ending(verdict="HEALTHY", reasons=(text,)),
        notes=(text,),
    )


def test_a_snapshot_survives_json() -> None:
    assert Snapshot.from_json(full().to_json()) == full()


@given(st.text(max_size=40))
def test_whatever_a_name_holds_the_json_is_one_line_fit_for_a_terminal(text: str) -> None:
    line = full(text).to_json().decode()
    assert line.isprintable()
    tree = json.loads(line)
    assert tree == full(text).to_dict()
    assert all(item.isprintable() for item in tree["notes"])


def test_a_name_of_bytes_that_are_no_utf_8_can_be_sent() -> None:
    assert full("left\udcff").to_dict()["actuator"] == "left\\xff"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None])
def test_what_is_no_number_is_not_known(value: float | None) -> None:
    assert known(value) is None


@pytest.mark.parametrize("line", [b"", b"[]", b'{"number": 1}', b"\xff"])
def test_what_is_no_snapshot_is_refused(line: bytes) -> None:
    with pytest.raises(ValueError, match="no snapshot"):
        Snapshot.from_json(line)
