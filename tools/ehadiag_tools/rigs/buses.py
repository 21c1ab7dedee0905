"""Foreign buses on which the reference recordings are played again: DBC and mapping of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_iface.bus_map import BusMap, resolve
from firmware_iface.dbc import parse_dbc
from firmware_iface.files import decode_toml
from firmware_iface.mapping_file import MappingFile

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
    "StandardCAN", "ExtendedCAN", *("reserved",) * 12, "StandardCAN_FD", "ExtendedCAN_FD"
)  # fmt: skip


def _name(signal: Signal) -> str:
    return "".join(part.capitalize() for part in signal.role.replace(".", "_").split("_"))


CURRENT, SPOOL, POSITION = (24 / 4096, 1 / 4096, 120 / 4096)
"""Steps of the default bus's converters, mA, mm, mm."""
PRESSURE = 50 / 4096
"""MPa."""


def _signals(text: str, *, big_endian: bool = False) -> tuple[Signal, ...]:
    """Signals of lines `role start bits step unit`; unsigned where there is a + behind the bits."""
    out = []
    for line in text.strip().splitlines():
        role, start, bits, step, *unit = line.split()
        signed, size = not bits.endswith("+"), int(bits.rstrip("+"))
        name = "".join(unit)
        out.append(Signal(role, int(start), size, float(step), name, big_endian, signed=signed))
    return tuple(out)


def _environment(can_id: int, unit: str = "bar", step: float = 0.01, **kind: bool) -> Message:
    text = f"""environment.supply_pressure 0 16+ {step} {unit}
        environment.return_pressure 16 16+ {step} {unit}
        environment.oil_temperature 32 16+ 0.1 K"""
    return Message(can_id, 6, _signals(text), every=100, at=0.1, **kind)


COMMAND = """command.position 0 16 0.002 mm
    command.current 16 16 0.0005 mA
    command.mode 32 8+ 1"""
SAMPLE = f"""channels.current 0 16 {CURRENT} mA
    channels.spool 16 16 {SPOOL} mm
    channels.pressure 32 16 {PRESSURE} MPa
    channels.position 48 16 {POSITION} mm"""


def _psi29() -> ForeignBus:
    command = """command.position 7 16 0.002 mm
        command.current 23 16 0.0005 mA
        command.mode 39 8+ 1"""
    valve = """channels.current 7 16 0.0005 mA
        channels.spool 23 16 0.00002 mm"""
    jack = """channels.pressure 7 16 0.12 psi
        channels.position 23 16 0.002 mm"""
    first, texts = 0x18FF0101, {"Command": (5, command, 0.3), "Valve": (4, valve, 0.5)}
    texts["Jack"] = (4, jack, 0.63)
    messages = {
        name: Message(first + k, size, _signals(text, big_endian=True), at=at, extended=True)
        for k, (name, (size, text, at)) in enumerate(texts.items())
    }
    messages["Oil"] = _environment(first + 3, "psi", 0.1, extended=True)
    about = "29-bit identifiers, big-endian, psi, the sample in two messages"
    return ForeignBus("psi29", about, messages)


def _single() -> ForeignBus:
    messages = {}
    for k, line in enumerate(SAMPLE.splitlines()):
        role, _, *rest = line.split()
        name, every = role.partition(".")[2], 2 if "position" in role else 1
        signals = _signals(" ".join((role, "0", *rest)))
        at = (5 + k) / 10
        messages[name.capitalize()] = Message(0x301 + k, 2, signals, every=every, at=at)
    messages["Command"] = Message(0x305, 5, _signals(COMMAND), every=2, at=0.3)
    messages["Oil"] = _environment(0x306)
    about = "one channel a message; position and command each second tick"
    return ForeignBus("single", about, messages)


def _canfd() -> ForeignBus:
    lines = [line.split() for line in f"{SAMPLE}\n{COMMAND}".splitlines()]
    text = "\n".join(
        f"{role} {32 * k} 32 1e-6 {unit}" for k, (role, *_, unit) in enumerate(lines[:6])
    )
    signals = _signals(f"{text}\ncommand.mode 192 8+ 1")
    messages = {"Everything": Message(0x410, 48, signals, fd=True), "Oil": _environment(0x411)}
    return ForeignBus("canfd", "CAN FD, command and sample in one message of micro-units", messages)


STATE = """status.state 0 8+ 1
    status.test_id 8 8+ 1
    status.elapsed 16 16+ 0.001 s
    status.serial 32 16+ 1"""

BUSES: tuple[ForeignBus, ...] = (
    _psi29(),
    _single(),
    _canfd(),
    ForeignBus(
        "status",
        "the sample and the state of the test, no command",
        {
            "Sample": Message(0x210, 8, _signals(SAMPLE)),
            "State": Message(0x211, 6, _signals(STATE), every=20, at=0.05),
            "Oil": _environment(0x212),
        },
    ),
    ForeignBus(
        "command",
        "the sample and the command, nothing that names the test",
        {
            "Command": Message(0x110, 5, _signals(COMMAND), at=0.4),
            "Sample": Message(0x111, 8, _signals(SAMPLE), at=0.53),
            "Oil": _environment(0x112),
        },
    ),
)
