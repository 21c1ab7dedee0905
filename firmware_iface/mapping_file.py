"""The schema of a mapping file: which signal of which message plays which role, in which unit."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

import msgspec

from firmware_iface.recording import MAX_CAN_ID, MAX_STANDARD_CAN_ID

MappingName = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
CanIdentifier = Annotated[int, msgspec.Meta(ge=0, le=MAX_CAN_ID)]
CodeNumber = Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]
BitStateName = Literal["idle", "arming", "running", "complete", "aborted", "refused"]
FaultAction = Literal["drop", "flag", "refuse"]
FrameShare = Annotated[float, msgspec.Meta(ge=0, le=1)]


class SignalRef(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One signal. SI value = SI(unit, physical * scale + offset)."""

    message: MappingName
    signal: MappingName
    unit: str | None = None
    """Overrides the DBC's unit text."""
    scale: float = 1.0
    """On top of the DBC's own, e.g. -1 where a sensor is mounted the other way round."""
    offset: float = 0.0


class ChannelRef(SignalRef, frozen=True, forbid_unknown_fields=True):
    """A measured channel, and what is known of the converter behind it, in the signal's unit."""

    range: tuple[float, float] | None = None
    """Values at the converter's ends, after scale and offset."""
    resolution: Annotated[float, msgspec.Meta(gt=0)] | None = None
    """One step of the converter; a bus signal may be finer."""


class ChannelSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The four measured channels."""

    current: ChannelRef
    spool: ChannelRef
    pressure: ChannelRef
    position: ChannelRef


COMMAND_MODES: dict[Literal["current", "position"], CodeNumber] = {"current": 1, "position": 2}
REQUEST_CODES: dict[Literal["start", "abort"], CodeNumber] = {"start": 1, "abort": 2}
"""Numbers on the bus, unless a mapping says others."""


class CommandSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the computer commands; at least one of current and position."""

    current: SignalRef | None = None
    position: SignalRef | None = None
    mode: SignalRef | None = None
    test_id: SignalRef | None = None
    modes: dict[Literal["current", "position"], CodeNumber] = msgspec.field(
        default_factory=COMMAND_MODES.copy
    )


class EnvironmentSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Supply and return pressure, and oil temperature."""

    supply_pressure: SignalRef | None = None
    return_pressure: SignalRef | None = None
    oil_temperature: SignalRef | None = None


class StatusSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of the built-in test."""

    state: SignalRef | None = None
    reason: SignalRef | None = None
    test_id: SignalRef | None = None
    elapsed: SignalRef | None = None
    serial: SignalRef | None = None
    states: dict[BitStateName, CodeNumber] = msgspec.field(
        default_factory={name: number for number, name in enumerate(get_args(BitStateName))}.copy
    )


class RequestSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Messages by which a tester requests a test."""

    code: SignalRef | None = None
    test_id: SignalRef | None = None
    codes: dict[Literal["start", "abort"], CodeNumber] = msgspec.field(
        default_factory=REQUEST_CODES.copy
    )


class OnboardSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Result of a computer that identifies by itself."""

    state: SignalRef | None = None
    test_id: SignalRef | None = None
    verdict: SignalRef | None = None
    runs: SignalRef | None = None
    Kintas: SignalRef | None = None
    FSS: SignalRef | None = None
    FDJ: SignalRef | None = None
    std_Kintas: SignalRef | None = None
    std_FSS: SignalRef | None = None
    std_FDJ: SignalRef | None = None


class UdsIdentifiers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """CAN identifiers of UDS over ISO-TP; both of 11 bits, or of 29 where one is above 0x7FF."""

    request_id: CanIdentifier = 0x7E0
    response_id: CanIdentifier = 0x7E8

    @property
    def extended(self) -> bool:
        """Whether the identifiers have 29 bits."""
        return max(self.request_id, self.response_id) > MAX_STANDARD_CAN_ID


class Protection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Counter and check sum by which a lost, repeated or damaged message is noticed."""

    counter: MappingName | None = None
    counts: Literal["frames", "ticks"] = "frames"
    """`ticks`: messages of one control tick carry the same number."""
    crc: MappingName | None = None
    crc_kind: Literal["crc8-j1850-id"] = "crc8-j1850-id"


class PolicyLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Share of a message's frames up to which `refuse` does not strike, for each kind."""

    crc: FrameShare = 0.0
    range: FrameShare = 0.0
    length: FrameShare = 0.0
    lost: FrameShare = 0.0
    repeated: FrameShare = 0.0
    out_of_order: FrameShare = 0.0


class Policy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What happens to a recording or sample that fails a check.

    `drop`: the sample is left out and counted; `flag`: it is used and counted (and noted where its
    value may be wrong); `refuse`: left out, and beyond its share in `limits` no verdict is given.
    """

    crc: FaultAction = "drop"
    range: FaultAction = "drop"
    length: Literal["drop", "refuse"] = "drop"
    lost: Literal["flag", "refuse"] = "flag"
    repeated: Literal["drop", "refuse"] = "drop"
    out_of_order: Literal["flag", "refuse"] = "flag"
    limits: PolicyLimits = PolicyLimits()


class MappingFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of a mapping file."""

    schema: Literal["ehadiag.mapping/1"]
    dbc: Annotated[str, msgspec.Meta(min_length=1, max_length=255)]
    """Path of the DBC, in or below the mapping's own folder."""
    tick_ms: Annotated[float, msgspec.Meta(ge=0.05, le=1000)] = 1.0
    """Control period, ms."""
    channel: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None
    """Adapter channel of a recording that is the actuator's."""
    id_offset: Annotated[int, msgspec.Meta(ge=-MAX_CAN_ID, le=MAX_CAN_ID)] = 0
    """Added to the identifiers of all messages."""
    channels: ChannelSignals
    command: CommandSignals = CommandSignals()
    environment: EnvironmentSignals = EnvironmentSignals()
    status: StatusSignals = StatusSignals()
    request: RequestSignals = RequestSignals()
    onboard: OnboardSignals = OnboardSignals()
    uds: UdsIdentifiers | msgspec.UnsetType = msgspec.UNSET
    protection: Annotated[dict[MappingName, Protection], msgspec.Meta(max_length=256)] = {}
    policy: Policy = Policy()
