"""Two actuators on one bus: their mappings, and a log of a test of each at the same time."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

import can

SHIFT = 0x400
"""Between the identifiers of the left and the right actuator's messages."""


def write_mappings(folder: Path) -> tuple[Path, Path]:
    """Write left.toml, the default bus, and right.toml, the same with other identifiers."""
    data = resources.files("firmware_iface").joinpath("data")
    dbc = data.joinpath("eha_fcc.dbc").read_text(encoding="utf-8")
    text = data.joinpath("eha_fcc.toml").read_text(encoding="utf-8")
    # The check sum counts the identifier: the frames of a log are moved, not encoded again.
    unchecked = re.sub(r"(?m)^crc = .*\n", "", text)
    for number in (272, 273, 288, 512, 513):
        dbc = re.sub(rf"(BO_ |VAL_ ){number}\b", rf"\g<1>{number + SHIFT}", dbc)
    (folder / "left.dbc").write_bytes(data.joinpath("eha_fcc.dbc").read_bytes())
    (folder / "right.dbc").write_text(dbc, encoding="utf-8")
    paths = folder / "left.toml", folder / "right.toml"
    for path, content in zip(paths, (text, unchecked), strict=True):
        path.write_text(content.replace("eha_fcc.dbc", f"{path.stem}.dbc"), encoding="utf-8")
    return paths


def messages_of(log: Path, shift: int = 0, begin: float = 1_700_000_000.0) -> list[can.Message]:
    """Return messages of a log as if it had begun then, identifiers shifted."""
    with can.LogReader(str(log)) as reader:
        found = list(reader)
    first = found[0].timestamp
    for message in found:
        message.timestamp += begin - first
        message.arbitration_id += shift
        message.channel = 0
    return found


def write_log(path: Path, left: Path, right: Path) -> Path:
    """Write a log of both actuators' tests from a log of each."""
    both = [*messages_of(left), *messages_of(right, SHIFT)]
    with can.Logger(str(path)) as writer:
        for message in sorted(both, key=lambda item: item.timestamp):
            writer(message)
    return path
