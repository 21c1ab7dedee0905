"""The schema of a mapping file: which signal of which message plays which role.

Untrusted input: every key is known, sizes are limited, and nothing in it is executed.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

import msgspec

__all__ = [
    "ChannelRef",
    "ChannelSignals",
    "CommandSignals",
    "EnvironmentSignals",
    "MappingFile",
    "OnboardSignals",
    "Policy",
    "PolicyLimits",
    "Protection",
    "RequestSignals",
    "SignalRef",
    "StatusSignals",
]

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
Number = Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]
State = Literal["idle", "arming", "running", "complete", "aborted", "refused"]
Action = Literal["drop", "flag", "refuse"]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class SignalRef(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One signal. SI value = SI(unit, physical * scale + offset)."""

    message: Name
    signal: Name
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


class CommandSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the computer commands; at least one of current and position."""

    current: SignalRef | None = None
    position: SignalRef | None = None
    mode: SignalRef | None = None
    test_id: SignalRef | None = None
    modes: dict[Literal["current", "position"], Number] = msgspec.field(
        default_factory=lambda: {"current": 1, "position": 2}
    )


class EnvironmentSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Supply, return, oil."""

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
    states: dict[State, Number] = msgspec.field(
        default_factory=lambda: {name: number for number, name in enumerate(get_args(State))}
    )


class RequestSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a tester asks for a test."""

    code: SignalRef | None = None
    test_id: SignalRef | None = None
    codes: dict[Literal["start", "abort"], Number] = msgspec.field(
        default_factory=lambda: {"start": 1, "abort": 2}
    )


class OnboardSignals(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a computer that identifies by itself says it has found."""

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


class Protection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How one message is guarded."""

    counter: Name | None = None
    counts: Literal["frames", "ticks"] = "frames"
    """`ticks`: messages of one control tick carry the same number."""
    crc: Name | None = None
    crc_kind: Literal["crc8-j1850-id"] = "crc8-j1850-id"


class PolicyLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Share of a message's frames up to which `refuse` does not strike, for each kind."""

    crc: Share = 0.0
    range: Share = 0.0
    length: Share = 0.0
    lost: Share = 0.0
    repeated: Share = 0.0
    out_of_order: Share = 0.0


class Policy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What happens to a recording or sample that fails a check.

    `drop`: the sample is left out and counted; `flag`: it is used and counted (and noted where its
    value may be wrong); `refuse`: left out, and beyond its share in `limits` no verdict is given.
    """

    crc: Action = "drop"
    range: Action = "drop"
    length: Literal["drop", "refuse"] = "drop"
    lost: Literal["flag", "refuse"] = "flag"
    repeated: Literal["drop", "refuse"] = "drop"
    out_of_order: Literal["flag", "refuse"] = "flag"
    limits: PolicyLimits = PolicyLimits()


class MappingFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole mapping file."""

    schema: Literal["ehadiag.mapping/1"]
    dbc: Annotated[str, msgspec.Meta(min_length=1, max_length=255)]
    """Path of the DBC, in or below the mapping's own folder."""
    tick_ms: Annotated[float, msgspec.Meta(ge=0.05, le=1000)] = 1.0
    """Control period."""
    channel: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None
    """Adapter channel of a recording that is the actuator's."""
    channels: ChannelSignals
    command: CommandSignals = CommandSignals()
    environment: EnvironmentSignals = EnvironmentSignals()
    status: StatusSignals = StatusSignals()
    request: RequestSignals = RequestSignals()
    onboard: OnboardSignals = OnboardSignals()
    protection: Annotated[dict[Name, Protection], msgspec.Meta(max_length=256)] = {}
    policy: Policy = Policy()
