"""Resolves a mapping file against its DBC into what decoder and encoder work from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import msgspec
from msgspec.structs import replace

from firmware_iface.dbc import DbcMessage, DbcSignal, SignalLayout, cached_dbc
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import MAX_DBC_BYTES, decode_toml, read_small_file, read_toml
from firmware_iface.mapping_file import (
    ChannelRef,
    MappingFile,
    OnboardSignals,
    Policy,
    Protection,
    SignalRef,
    UdsIdentifiers,
)
from firmware_iface.recording import (
    CHANNELS,
    MAX_CAN_ID,
    MAX_STANDARD_CAN_ID,
    BitState,
    CommandMode,
    StatedConverter,
)
from firmware_iface.transport.frames import MAX_PAYLOAD

UNIT_SCALES: dict[str, dict[str, tuple[float, float]]] = {
    "current": {"A": (1.0, 0.0), "mA": (1e-3, 0.0), "uA": (1e-6, 0.0)},
    "length": {
        "m": (1.0, 0.0),
        "cm": (1e-2, 0.0),
        "mm": (1e-3, 0.0),
        "um": (1e-6, 0.0),
        "in": (0.0254, 0.0),
        "mil": (25.4e-6, 0.0),
    },
    "pressure": {
        "Pa": (1.0, 0.0),
        "hPa": (1e2, 0.0),
        "kPa": (1e3, 0.0),
        "MPa": (1e6, 0.0),
        "mbar": (1e2, 0.0),
        "bar": (1e5, 0.0),
        "psi": (6894.757293168361, 0.0),
    },
    # Temperatures are kept in degC, the scale of the viscosity laws.
    "temperature": {
        "degC": (1.0, 0.0),
        "C": (1.0, 0.0),
        "K": (1.0, -273.15),
        "degF": (5.0 / 9.0, -160.0 / 9.0),
    },
    "time": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0)},
}
"""Per dimension: unit text -> (gain, bias), SI value = gain * value + bias."""
UNIT_SPELLINGS = {
    "µA": "uA",
    "μA": "uA",
    "µm": "um",
    "μm": "um",
    "µs": "us",
    "μs": "us",
    "°C": "degC",
    "°F": "degF",
    "deg C": "degC",
    "deg F": "degF",
    "inch": "in",
    "Volts": "V",
    "sec": "s",
    "msec": "ms",
}


def si_factor(text: str, dimension: str, where: str) -> tuple[float, float]:
    """Gain and bias of a unit: SI value = gain · value + bias.

    text: the unit as written; dimension: quantity that it must measure, a key of `UNIT_SCALES`;
    where: beginning of the error message. ConfigurationError: no unit, or not one of the dimension.
    """
    known = UNIT_SCALES[dimension]
    unit = UNIT_SPELLINGS.get(text.strip(), text.strip())
    if unit in known:
        return known[unit]
    if not unit:
        raise ConfigurationError(
            f"{where}: the DBC gives no unit; add unit = … ({', '.join(known)}) to the mapping"
        )
    raise ConfigurationError(
        f"{where}: unit {text.strip()!r} is no {dimension} (known: {', '.join(known)})"
    )


MIN_SCALE, MAX_SCALE = 1e-12, 1e12
"""Magnitudes of scales that a physical quantity can have; beyond them arithmetic overflows."""

MAX_RELATIVE_STEP = 1.0 / 64.0
"""Resolution over range of a converter of 6 bits, the coarsest that is taken."""

ONBOARD_SEVERITIES = ("Kintas", "FSS", "FDJ")
"""Keys of what a computer finds by itself, their standard deviations behind `std_`."""

NEEDED_ONBOARD_SIGNALS = {
    "onboard.state",
    *(f"onboard.{prefix}{name}" for prefix in ("", "std_") for name in ONBOARD_SEVERITIES),
}
"""Without which the rest of `onboard` says nothing."""

ROLE_DIMENSIONS: dict[str, dict[str, str | None]] = {
    "channels": {
        "current": "current",
        "spool": "length",
        "pressure": "pressure",
        "position": "length",
    },
    "command": {"current": "current", "position": "length", "mode": None, "test_id": None},
    "environment": {
        "supply_pressure": "pressure",
        "return_pressure": "pressure",
        "oil_temperature": "temperature",
    },
    "status": {
        "state": None,
        "reason": None,
        "test_id": None,
        "elapsed": "time",
        "serial": None,
    },
    "request": {"code": None, "test_id": None},
    "onboard": dict.fromkeys(
        (
            "state",
            "test_id",
            "verdict",
            "runs",
            *ONBOARD_SEVERITIES,
            *(f"std_{n}" for n in ONBOARD_SEVERITIES),
        )
    ),
}


ConverterOrUnset: TypeAlias = StatedConverter | msgspec.UnsetType
"""Unset where nothing is said, so that the fingerprint of a mapping is that of what it says."""


class Role(msgspec.Struct, frozen=True):
    """A signal in its role: SI value = physical * gain + bias."""

    name: str
    """Section and key of the mapping, as `channels.spool`."""
    signal: SignalLayout
    gain: float = 1.0
    bias: float = 0.0
    stated: ConverterOrUnset = msgspec.UNSET
    """What the mapping says of the converter behind a channel, SI."""


class MessageMap(msgspec.Struct, frozen=True):
    """One message that carries roles, and how it is guarded."""

    name: str
    can_id: int
    extended: bool
    fd: bool
    length: int
    roles: tuple[Role, ...]
    counter: SignalLayout | None = None
    counts_ticks: bool = False
    crc: SignalLayout | None = None
    crc_kind: str = "none"
    cycle_ns: int = 0
    """Nominal time between frames; 0: on event or not said."""

    @property
    def modulus(self) -> int:
        """Counts per turn of the counter."""
        return 1 << self.counter.length if self.counter else 0

    @property
    def measures(self) -> bool:
        """Whether it brings a measured channel."""
        return any(role.name.startswith("channels.") for role in self.roles)


class BusMap(msgspec.Struct, frozen=True):
    """All messages in use, by name, and the numbers that stand for states."""

    name: str
    tick_ns: int
    messages: Mapping[str, MessageMap]
    modes: Mapping[int, CommandMode]
    fixed_mode: CommandMode | None
    states: Mapping[int, BitState]
    requests: Mapping[str, int]
    policy: Policy
    channel: int | None = None
    """Adapter channel of a recording that is the actuator's, from 1; None: the only one."""
    id_offset: int = 0
    """Added already to the DBC's identifiers."""
    onboard: tuple[MessageMap, ...] = ()
    """Messages of what the computer has found by itself; no part of a recording's samples."""
    uds: UdsIdentifiers | msgspec.UnsetType = msgspec.UNSET
    """Identifiers of UDS as the mapping has them, without `id_offset`."""

    def find(self, role: str) -> tuple[MessageMap, Role] | None:
        """Message and signal of a role (`command.mode`); None if the mapping leaves it out."""
        for message in self.messages.values():
            for item in message.roles:
                if item.name == role:
                    return message, item
        return None

    @property
    def uds_identifiers(self) -> UdsIdentifiers:
        """Identifiers of UDS; ConfigurationError: one would be none, or a mapped message's."""
        given = UdsIdentifiers() if isinstance(self.uds, msgspec.UnsetType) else self.uds
        pair = given.request_id + self.id_offset, given.response_id + self.id_offset
        used = {item.can_id for item in (*self.messages.values(), *self.onboard)}
        most = MAX_CAN_ID if given.extended else MAX_STANDARD_CAN_ID
        if pair[0] == pair[1] or used & {*pair} or not 0 <= min(pair) <= max(pair) <= most:
            raise ConfigurationError(
                f"{self.name}: uds: request_id {pair[0]:#x} and response_id {pair[1]:#x} must be"
                f" two identifiers of no mapped message, 0 … {most:#x}"
            )
        return UdsIdentifiers(*pair)

    def shifted(self, id_offset: int) -> BusMap:
        """Return the map of a sister unit, whose identifiers are so much greater.

        ConfigurationError: an identifier would be none.
        """
        moved = id_offset - self.id_offset
        messages = {name: _shifted(item, moved) for name, item in self.messages.items()}
        onboard = tuple(_shifted(item, moved) for item in self.onboard)
        return replace(self, messages=messages, onboard=onboard, id_offset=id_offset)

    @property
    def request_identifiers(self) -> frozenset[tuple[int, bool]]:
        """Identifiers, and whether they are extended, of all that requests something.

        The own messages of requests, and UDS unless a mapped message has the identifier.
        """
        given = UdsIdentifiers() if isinstance(self.uds, msgspec.UnsetType) else self.uds
        uds = UdsIdentifiers(given.request_id + self.id_offset, given.response_id + self.id_offset)
        mapped = {(item.can_id, item.extended) for item in (*self.messages.values(), *self.onboard)}
        own = {
            (message.can_id, message.extended)
            for message in self.messages.values()
            if any(role.name.startswith("request.") for role in message.roles)
        }
        return frozenset(own | ({(uds.request_id, uds.extended)} - mapped))

    @property
    def stated(self) -> tuple[StatedConverter | None, ...]:
        """What the mapping says of each channel's converter; empty: nothing of any."""
        roles = (self.find(f"channels.{channel.name}") for channel in CHANNELS)
        stated = tuple(
            None
            if found is None or isinstance(found[1].stated, msgspec.UnsetType)
            else found[1].stated
            for found in roles
        )
        return stated if any(stated) else ()


def default_map(dbc: Path | str | None = None) -> BusMap:
    """Return the default bus (BUS-2, `data/eha_fcc.dbc`), or that of a DBC of the same names.

    dbc: DBC to use instead of the one that comes with the package. InputOutputError: the DBC cannot
    be read; ConfigurationError: not a DBC, or one of other names than the default mapping's.
    """
    folder = Path(__file__).parent / "data"
    where = "bundled mapping eha_fcc.toml"
    tree = decode_toml(folder.joinpath("eha_fcc.toml").read_bytes(), MappingFile, where)
    if dbc is None:
        text = folder.joinpath(tree.dbc).read_bytes()
        return resolve(tree, cached_dbc(text, tree.dbc), where, tree.dbc)
    found = cached_dbc(read_small_file(Path(dbc), MAX_DBC_BYTES, "DBC file"), str(dbc))
    tree = _without_onboard(tree, found)
    try:
        return resolve(tree, found, where, str(dbc))
    except ConfigurationError as error:
        raise ConfigurationError(
            f"DBC file {dbc}: names another bus than the default mapping ({error}): name a mapping"
            " file, --mapping"
        ) from None


def _without_onboard(tree: MappingFile, database: Mapping[str, DbcMessage]) -> MappingFile:
    """Leave out what a computer finds by itself, where a DBC knows no such messages."""
    refs = [ref for ref in msgspec.structs.astuple(tree.onboard) if ref is not None]
    named = {ref.message for ref in refs}
    if named & database.keys():
        return tree
    guards = {name: item for name, item in tree.protection.items() if name not in named}
    return msgspec.structs.replace(tree, onboard=OnboardSignals(), protection=guards)


def load_map(path: Path | str, dbc: Path | str | None = None) -> BusMap:
    """Read a mapping file and its DBC (`dbc` overrides the one that the mapping names).

    path: mapping file; dbc: DBC to use instead of the one that the mapping names. Returns the map,
    checked. InputOutputError: a file cannot be read; ConfigurationError: not a mapping, not a DBC,
    a signal that does not exist or has a wrong unit.
    """
    path = Path(path)
    tree = read_toml(path, MappingFile, "mapping file")
    if dbc is None:
        inside = PurePosixPath(tree.dbc)
        if inside.is_absolute() or ".." in inside.parts or "\\" in tree.dbc or "\0" in tree.dbc:
            raise ConfigurationError(
                f"mapping file {path}: dbc must be a path in the mapping's folder, not"
                f" {tree.dbc!r}; name a DBC elsewhere by --dbc"
            )
        dbc = path.parent / inside
    text = read_small_file(Path(dbc), MAX_DBC_BYTES, "DBC file")
    return resolve(tree, cached_dbc(text, str(dbc)), f"mapping file {path}", str(dbc))


def resolve(
    tree: MappingFile, database: Mapping[str, DbcMessage], where: str, dbc_name: str
) -> BusMap:
    """Resolve a mapping against the messages of a DBC; `where` begins the error texts."""
    roles: dict[str, list[Role]] = {}
    for section, dimensions in ROLE_DIMENSIONS.items():
        signals = getattr(tree, section)
        for key, dimension in dimensions.items():
            ref = getattr(signals, key)
            if ref is not None:
                role = _role(ref, f"{section}.{key}", dimension, database, where)
                roles.setdefault(ref.message, []).append(role)
    for name in tree.protection:
        if name not in roles:
            raise ConfigurationError(f"{where}: protection of {name!r}, which no role uses")
    messages = {
        name: _message(database[name], tuple(items), tree.protection.get(name), where)
        for name, items in roles.items()
    }
    seen: dict[tuple[int, bool], str] = {}
    _refuse_incomplete(roles, where)
    for item in messages.values():
        other = seen.setdefault((item.can_id, item.extended), item.name)
        if other != item.name:
            raise ConfigurationError(f"{where}: {other} and {item.name} share an identifier")
    onboard = tuple(item for item in messages.values() if _onboard(item))
    messages = {item.name: item for item in messages.values() if not _onboard(item)}
    moduli = {item.modulus for item in messages.values() if item.counts_ticks}
    if len(moduli) > 1:
        raise ConfigurationError(f"{where}: counters that count ticks must be equally wide")
    modes = {tree.command.modes[key]: CommandMode[key.upper()] for key in tree.command.modes}
    states = {tree.status.states[key]: BitState[key.upper()] for key in tree.status.states}
    return BusMap(
        name=dbc_name,
        tick_ns=round(tree.tick_ms * 1e6),
        messages=messages,
        modes=modes,
        fixed_mode=_fixed_mode(tree, where),
        states=states,
        requests={str(key): value for key, value in tree.request.codes.items()},
        policy=tree.policy,
        channel=tree.channel,
        onboard=onboard,
        uds=tree.uds,
    ).shifted(tree.id_offset)


def _shifted(message: MessageMap, by: int) -> MessageMap:
    can_id = message.can_id + by
    most = MAX_CAN_ID if message.extended else MAX_STANDARD_CAN_ID
    if not 0 <= can_id <= most:
        raise ConfigurationError(
            f"id offset: {message.name} would have the identifier {can_id:#x}; need 0 … {most:#x}"
        )
    return replace(message, can_id=can_id)


def _onboard(message: MessageMap) -> bool:
    return message.roles[0].name.startswith("onboard.")


def _refuse_incomplete(roles: Mapping[str, list[Role]], where: str) -> None:
    """Refuse findings without what makes them whole, or in a message with anything else."""
    named = {item.name for items in roles.values() for item in items}
    ours = {name for name in named if name.startswith("onboard.")}
    missing = sorted(NEEDED_ONBOARD_SIGNALS - named) if ours else []
    if missing:
        raise ConfigurationError(f"{where}: onboard: {missing[0]} is needed beside the rest")
    for name, items in roles.items():
        if 0 < sum(item.name in ours for item in items) < len(items):
            raise ConfigurationError(f"{where}: {name} carries onboard findings and other signals")


def _fixed_mode(tree: MappingFile, where: str) -> CommandMode | None:
    command = tree.command
    if command.mode is not None:
        return None
    if command.current is not None and command.position is not None:
        raise ConfigurationError(
            f"{where}: command.mode is needed where both a current and a position are commanded"
        )
    if command.current is not None:
        return CommandMode.CURRENT
    return CommandMode.POSITION if command.position is not None else None


def _role(
    ref: SignalRef,
    name: str,
    dimension: str | None,
    database: Mapping[str, DbcMessage],
    where: str,
) -> Role:
    at = f"{where}: {name}"
    message = database.get(ref.message)
    if message is None:
        raise ConfigurationError(f"{at}: the DBC has no message {ref.message!r}")
    signal = _layout(message, ref.signal, at)
    gain, bias = (1.0, 0.0)
    if dimension is not None:
        text = ref.unit if ref.unit is not None else signal.unit
        gain, bias = si_factor(text, dimension, f"{at} ({ref.message}.{ref.signal})")
    if not MIN_SCALE <= abs(ref.scale) <= MAX_SCALE or abs(ref.offset) > MAX_SCALE:
        raise ConfigurationError(
            f"{at}: scale must lie within {MIN_SCALE:g} … {MAX_SCALE:g}, offset within "
            f"±{MAX_SCALE:g}"
        )
    stated = _stated(ref, gain, bias, at) if isinstance(ref, ChannelRef) else msgspec.UNSET
    return Role(name, signal, gain * ref.scale, gain * ref.offset + bias, stated)


def _stated(ref: ChannelRef, gain: float, bias: float, at: str) -> ConverterOrUnset:
    """What a mapping says of a converter, from the channel's unit to SI."""
    if ref.range is None and ref.resolution is None:
        return msgspec.UNSET
    low, high = None, None
    if ref.range is not None:
        if not ref.range[0] < ref.range[1]:
            raise ConfigurationError(f"{at}: range must be [least, most], not {list(ref.range)!r}")
        low, high = (gain * value + bias for value in ref.range)
        if ref.resolution is not None and ref.resolution > MAX_RELATIVE_STEP * (
            ref.range[1] - ref.range[0]
        ):
            raise ConfigurationError(
                f"{at}: resolution {ref.resolution:g} is more than {MAX_RELATIVE_STEP:g} of "
                f"the range"
            )
    return StatedConverter(low, high, None if ref.resolution is None else gain * ref.resolution)


def _layout(message: DbcMessage, name: str, at: str, depth: int = 0) -> SignalLayout:
    found = next((item for item in message.signals if item.name == name), None)
    if found is None:
        raise ConfigurationError(f"{at}: message {message.name!r} has no signal {name!r}")
    return signal_layout(found, message, at, depth)


def signal_layout(signal: DbcSignal, message: DbcMessage, at: str, depth: int = 0) -> SignalLayout:
    """Layout of a signal, with its chain of multiplexers."""
    scale, offset = signal.scale, signal.offset
    if scale is None or offset is None or not 1 <= signal.length <= 64:
        raise ConfigurationError(f"{at}: signal {signal.name!r} is not a plain number")
    if not MIN_SCALE <= abs(scale) <= MAX_SCALE or not abs(offset) <= MAX_SCALE:
        raise ConfigurationError(
            f"{at}: the DBC gives signal {signal.name!r} a scale outside {MIN_SCALE:g} …"
            f" {MAX_SCALE:g}, or an offset beyond"
        )
    if depth > 8:
        raise ConfigurationError(f"{at}: the multiplexers of {message.name!r} go in a circle")
    selectors: tuple[tuple[SignalLayout, frozenset[int]], ...] = ()
    if signal.multiplexer is not None and signal.multiplexer_ids:
        parent = _layout(message, signal.multiplexer, at, depth + 1)
        selectors = (*parent.selectors, (parent, frozenset(signal.multiplexer_ids)))
    low, high = signal.minimum, signal.maximum
    ranged = low is not None and high is not None and low < high
    layout = SignalLayout(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=signal.is_signed,
        is_float=signal.is_float,
        scale=scale,
        offset=offset,
        minimum=low if ranged else None,
        maximum=high if ranged else None,
        unit=signal.unit,
        selectors=selectors,
    )
    if layout.last_byte >= message.length:
        raise ConfigurationError(f"{at}: signal {signal.name!r} does not fit its message")
    return layout


def _message(
    message: DbcMessage, roles: tuple[Role, ...], guard: Protection | None, where: str
) -> MessageMap:
    guard = guard or Protection()
    at = f"{where}: protection.{message.name}"
    counter = _layout(message, guard.counter, at) if guard.counter else None
    crc = _layout(message, guard.crc, at) if guard.crc else None
    if counter is not None and (counter.is_float or not 2 <= counter.length <= 32):
        raise ConfigurationError(
            f"{at}: counter {counter.name!r} must be an integer of 2 … 32 bits"
        )
    if crc is not None and (crc.length != 8 or crc.lead % 8):
        raise ConfigurationError(f"{at}: check sum {crc.name!r} must fill one byte")
    if message.length > MAX_PAYLOAD:
        raise ConfigurationError(f"{where}: message {message.name!r} is longer than a CAN FD frame")
    return MessageMap(
        name=message.name,
        can_id=message.frame_id,
        extended=message.extended,
        fd=message.fd,
        length=message.length,
        roles=roles,
        counter=counter,
        counts_ticks=counter is not None and guard.counts == "ticks",
        crc=crc,
        crc_kind=guard.crc_kind if crc is not None else "none",
        cycle_ns=message.cycle_ms * 1_000_000,
    )
