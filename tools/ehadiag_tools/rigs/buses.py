"""Foreign buses on which the reference recordings are played again: DBC and mapping of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ehadiag.core.toml_file import decode_toml
from firmware_iface.mapping.bus_map import BusMap, resolve
from firmware_iface.mapping.dbc import parse_dbc
from firmware_iface.mapping.file import MappingFile

__all__ = ["BUSES", "ForeignBus"]

TICK_MS = 1.0


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal: its role in the mapping, and its place in the message."""

    role: str
    start: int
    bits: int
    scale: float
    unit: str
    big_endian: bool = False
    signed: bool = True

    def dbc(self, name: str) -> str:
        """Its line in a DBC."""
        order = 0 if self.big_endian else 1
        sign = "-" if self.signed else "+"
        place = f"{self.start}|{self.bits}@{order}{sign}"
        return f' SG_ {name} : {place} ({self.scale:.12g},0) [0|0] "{self.unit}" RIG'


@dataclass(frozen=True, slots=True)
class Message:
    """One message, sent each `every` ticks, `at` of a tick after the tick's begin."""

    can_id: int
    length: int
    signals: tuple[Signal, ...]
    every: int = 1
    at: float = 0.5
    extended: bool = False
    fd: bool = False


@dataclass(frozen=True, slots=True)
class ForeignBus:
    """A bus: its messages by name."""

    name: str
    about: str
    messages: Mapping[str, Message] = field(default_factory=dict)

    def dbc(self) -> str:
        """The DBC."""
        lines = ['VERSION "1.0"', "", "BU_: FCC RIG", ""]
        formats = []
        for name, item in self.messages.items():
            number = item.can_id | (1 << 31 if item.extended else 0)
            lines.append(f"BO_ {number} {name}: {item.length} FCC")
            lines += [signal.dbc(_name(signal)) for signal in item.signals]
            lines.append("")
            kind = 14 if item.fd else 0
            formats.append(f'BA_ "VFrameFormat" BO_ {number} {kind};')
        if any(item.fd for item in self.messages.values()):
            kinds = ",".join(f'"{text}"' for text in FRAME_FORMATS)
            lines.append(f'BA_DEF_ BO_ "VFrameFormat" ENUM {kinds};')
            lines.append('BA_DEF_DEF_ "VFrameFormat" "StandardCAN";')
            lines += formats
        return "\n".join(lines) + "\n"

    def mapping(self) -> str:
        """The mapping file."""
        sections: dict[str, list[str]] = {}
        for name, item in self.messages.items():
            for signal in item.signals:
                section, key = signal.role.split(".")
                ref = f'{{ message = "{name}", signal = "{_name(signal)}" }}'
                sections.setdefault(section, []).append(f"{key} = {ref}")
        lines = ['schema = "ehadiag.mapping/1"', f'dbc = "{self.name}.dbc"', f"tick_ms = {TICK_MS}"]
        for section, keys in sections.items():
            lines += ["", f"[{section}]", *keys]
        return "\n".join(lines) + "\n"

    def bus_map(self) -> BusMap:
        """What decoder and encoder work from."""
        tree = decode_toml(self.mapping().encode(), MappingFile, f"mapping of {self.name}")
        return resolve(
            tree,
            parse_dbc(self.dbc().encode(), self.name),
            f"mapping of {self.name}",
            f"{self.name}.dbc",
        )


FRAME_FORMATS = (
    "StandardCAN",
    "ExtendedCAN",
    *("reserved",) * 12,
    "StandardCAN_FD",
    "ExtendedCAN_FD",
)


def _name(signal: Signal) -> str:
    return "".join(part.capitalize() for part in signal.role.replace(".", "_").split("_"))


def _both_commands(*, big_endian: bool = False) -> tuple[Signal, ...]:
    starts = (7, 23, 39) if big_endian else (0, 16, 32)
    return (
        Signal("command.position", starts[0], 16, 0.002, "mm", big_endian),
        Signal("command.current", starts[1], 16, 0.0005, "mA", big_endian),
        Signal("command.mode", starts[2], 8, 1, "", big_endian, signed=False),
    )


def _environment(can_id: int, *, extended: bool = False, unit: str = "bar") -> Message:
    scale = 0.01 if unit == "bar" else 0.1
    return Message(
        can_id,
        6,
        (
            Signal("environment.supply_pressure", 0, 16, scale, unit, signed=False),
            Signal("environment.return_pressure", 16, 16, scale, unit, signed=False),
            Signal("environment.oil_temperature", 32, 16, 0.1, "K", signed=False),
        ),
        every=100,
        at=0.1,
        extended=extended,
    )


CURRENT, SPOOL, POSITION = (24 / 4096, 1 / 4096, 120 / 4096)
"""Steps of the default bus's converters, mA, mm, mm."""
PRESSURE = 50 / 4096
"""MPa."""

_FOUR = (
    Signal("channels.current", 0, 16, CURRENT, "mA"),
    Signal("channels.spool", 16, 16, SPOOL, "mm"),
    Signal("channels.pressure", 32, 16, PRESSURE, "MPa"),
    Signal("channels.position", 48, 16, POSITION, "mm"),
)

BUSES: tuple[ForeignBus, ...] = (
    ForeignBus(
        "psi29",
        "29-bit identifiers, big-endian, psi, the sample in two messages",
        {
            "Command": Message(
                0x18FF0101, 5, _both_commands(big_endian=True), at=0.3, extended=True
            ),
            "Valve": Message(
                0x18FF0102,
                4,
                (
                    Signal("channels.current", 7, 16, 0.0005, "mA", big_endian=True),
                    Signal("channels.spool", 23, 16, 0.00002, "mm", big_endian=True),
                ),
                at=0.5,
                extended=True,
            ),
            "Jack": Message(
                0x18FF0103,
                4,
                (
                    Signal("channels.pressure", 7, 16, 0.12, "psi", big_endian=True),
                    Signal("channels.position", 23, 16, 0.002, "mm", big_endian=True),
                ),
                at=0.63,
                extended=True,
            ),
            "Oil": _environment(0x18FF0104, extended=True, unit="psi"),
        },
    ),
    ForeignBus(
        "single",
        "one channel a message; position and command each second tick",
        {
            "Current": Message(
                0x301, 2, (Signal("channels.current", 0, 16, CURRENT, "mA"),), at=0.5
            ),
            "Spool": Message(0x302, 2, (Signal("channels.spool", 0, 16, SPOOL, "mm"),), at=0.6),
            "Pressure": Message(
                0x303, 2, (Signal("channels.pressure", 0, 16, PRESSURE, "MPa"),), at=0.7
            ),
            "Position": Message(
                0x304, 2, (Signal("channels.position", 0, 16, POSITION, "mm"),), every=2, at=0.8
            ),
            "Command": Message(0x305, 5, _both_commands(), every=2, at=0.3),
            "Oil": _environment(0x306),
        },
    ),
    ForeignBus(
        "canfd",
        "CAN FD, command and sample in one message of micro-units",
        {
            "Everything": Message(
                0x410,
                48,
                (
                    Signal("channels.current", 0, 32, 1e-6, "mA"),
                    Signal("channels.spool", 32, 32, 1e-6, "mm"),
                    Signal("channels.pressure", 64, 32, 1e-6, "MPa"),
                    Signal("channels.position", 96, 32, 1e-6, "mm"),
                    Signal("command.position", 128, 32, 1e-6, "mm"),
                    Signal("command.current", 160, 32, 1e-6, "mA"),
                    Signal("command.mode", 192, 8, 1, "", signed=False),
                ),
                fd=True,
            ),
            "Oil": _environment(0x411),
        },
    ),
    ForeignBus(
        "status",
        "the sample and the state of the test, no command",
        {
            "Sample": Message(0x210, 8, _FOUR),
            "State": Message(
                0x211,
                6,
                (
                    Signal("status.state", 0, 8, 1, "", signed=False),
                    Signal("status.test_id", 8, 8, 1, "", signed=False),
                    Signal("status.elapsed", 16, 16, 0.001, "s", signed=False),
                    Signal("status.serial", 32, 16, 1, "", signed=False),
                ),
                every=20,
                at=0.05,
            ),
            "Oil": _environment(0x212),
        },
    ),
    ForeignBus(
        "command",
        "the sample and the command, nothing that names the test",
        {
            "Command": Message(0x110, 5, _both_commands(), at=0.4),
            "Sample": Message(0x111, 8, _FOUR, at=0.53),
            "Oil": _environment(0x112),
        },
    ),
)
