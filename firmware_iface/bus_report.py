"""Reports what a bus carries: which messages map, what is missing, rates, pauses, range use."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.frame_faults import drop_conflicts, too_many_conflicts
from firmware_iface.alignment.ticks import TickAxis, place_frames
from firmware_iface.bus_map import ROLE_DIMENSIONS, BusMap, MessageMap
from firmware_iface.codec import Decoded, channels_in, choose_channel, decode
from firmware_iface.recording import (
    CHANNELS,
    MAX_SAMPLE_GAP_S,
    BitReason,
    BitState,
    Channel,
    IntArray,
)
from firmware_iface.transport.frames import FrameTable


def bit_state_text(messages: Mapping[str, Decoded], bus_map: BusMap) -> str:
    """Say what the computer told last of its test.

    Returns one sentence; empty where it told nothing.
    """
    lead = bus_map.find("status.state")
    if lead is None or not len(messages[lead[0].name].row):
        return ""
    item = messages[lead[0].name]

    def last(key: str) -> float:
        known = item.values.get(f"status.{key}", np.empty(0))
        known = known[np.isfinite(known)]
        return float(known[-1]) if len(known) else float("nan")

    stated = bus_map.states.get(int(last("state")) if np.isfinite(last("state")) else -1)
    if stated is None:
        return f"state of the test: {last('state'):g}, which the mapping does not name"
    words = f"state of the test: {stated.name.lower()}"
    if np.isfinite(last("test_id")) and last("test_id") > 0:
        words += f", test {last('test_id'):.0f}"
    if stated is BitState.RUNNING and np.isfinite(last("elapsed")):
        words += f", {last('elapsed'):.1f} s since its start"
    if stated in (BitState.REFUSED, BitState.ABORTED) and np.isfinite(last("reason")):
        number = int(last("reason"))
        if number in BitReason.__members__.values():
            words += f" ({BitReason(number).name.lower().replace('_', ' ')})"
    return words


class MessageReport(msgspec.Struct, frozen=True):
    """One mapped message."""

    name: str
    can_id: int
    extended: bool
    roles: tuple[str, ...]
    """What it carries for us."""
    received: int
    """Frames."""
    crc_errors: int
    length_errors: int
    range_errors: int
    lost: int | None
    """Frames that the counter says are missing; None without a counter."""
    conflicts: int
    """Counter values that came with different payloads."""
    rate: float
    """Frames per second, 0 with fewer than two."""
    longest_pause: float
    """Between two frames, s."""
    jitter: float
    """Standard deviation of the time between frames, s."""
    counter: bool
    """Whether the mapping has them."""
    crc: bool


class RangeUse(msgspec.Struct, frozen=True):
    """Use of one converter channel: raw codes seen, codes possible (None for floats), SI values,
    the last of them."""

    channel: str
    lowest_code: int | None
    highest_code: int | None
    codes: int | None
    lowest: float
    highest: float
    now: float
    saturated: int


class BusReport(msgspec.Struct, frozen=True):
    """What was heard."""

    duration: float
    """s."""
    frames: int
    """All frames, error frames."""
    errors: int
    messages: tuple[MessageReport, ...]
    """Mapped messages, heard or not."""
    ranges: tuple[RangeUse, ...]
    """Channels of which a sample was heard."""
    foreign: tuple[tuple[int, bool, int], ...]
    """Identifier, whether extended, frames; the most frequent first."""
    delay: float | None
    """Median time from a command to the telemetry of its tick, s; None if unknown."""
    state: str
    """What the computer said last of its test, in plain words; empty where it says nothing."""
    problems: tuple[str, ...]
    """What stands in the way of a diagnosis, one sentence each; empty if nothing."""
    remarks: tuple[str, ...]
    """What a diagnosis has to assume, or may stumble over, one sentence each."""


def report_bus(table: FrameTable, bus_map: BusMap) -> BusReport:
    """Report on some seconds of a bus."""
    channel, ambiguous = choose_channel(bus_map.channel, channels_in(table, bus_map))
    decoded = decode(table, replace(bus_map, channel=channel))
    received = decoded.messages
    axis = place_frames(decoded, bus_map.tick_ns)
    decoded, axis, conflicts = drop_conflicts(decoded, axis)
    messages = tuple(
        _message(received[name], table, conflicts[name].count if name in conflicts else 0)
        for name in decoded.messages
    )
    ranges = tuple(use for item in decoded.messages.values() for use in _ranges(item, table))
    span = int(table.time_ns.max() - table.time_ns.min()) if len(table) else 0
    return BusReport(
        duration=span * 1e-9,
        frames=len(table),
        errors=len(decoded.errors),
        messages=messages,
        ranges=ranges,
        foreign=_foreign(table, decoded.foreign),
        delay=_delay(decoded.messages, axis),
        state=bit_state_text(decoded.messages, bus_map),
        problems=((ambiguous,) if ambiguous else ()) + _problems(messages, len(table)),
        remarks=(*_pauses(messages), *_unmapped(decoded.messages, len(table))),
    )


def _message(item: Decoded, table: FrameTable, conflicts: int) -> MessageReport:
    message = item.message
    stamps = np.sort(table.time_ns[item.received])
    steps = np.diff(stamps) * 1e-9
    span = float(steps.sum())
    return MessageReport(
        name=message.name,
        can_id=message.can_id,
        extended=message.extended,
        roles=tuple(role.name for role in message.roles),
        received=len(item.received),
        crc_errors=len(item.crc_bad),
        length_errors=len(item.length_bad),
        range_errors=len(item.range_bad),
        lost=_lost(item),
        conflicts=conflicts,
        rate=len(steps) / span if span > 0 else 0.0,
        longest_pause=float(steps.max()) if len(steps) else 0.0,
        jitter=float(steps.std()) if len(steps) else 0.0,
        counter=message.counter is not None,
        crc=message.crc is not None,
    )


def _lost(item: Decoded) -> int | None:
    if item.counter is None:
        return None
    modulus = item.modulus
    step = np.diff(item.counter) % modulus
    missing = int((step[(step > 1) & (step <= modulus // 2)] - 1).sum())
    return max(missing - len(item.crc_bad) - len(item.length_bad), 0)


def _ranges(item: Decoded, table: FrameTable) -> list[RangeUse]:
    data = table.data[item.row]
    uses = []
    for role in item.message.roles:
        if role.name not in item.saturated:
            continue
        known = np.isfinite(item.values[role.name])
        if not known.any():
            continue
        value = item.values[role.name][known]
        low = high = codes = None
        if not role.signal.is_float:
            raw = role.signal.raw(data[known])
            low, high, codes = int(raw.min()), int(raw.max()), 1 << role.signal.length
        uses.append(
            RangeUse(
                channel=role.name.removeprefix("channels."),
                lowest_code=low,
                highest_code=high,
                codes=codes,
                lowest=float(value.min()),
                highest=float(value.max()),
                now=float(value[-1]),
                saturated=int(item.saturated[role.name][known].sum()),
            )
        )
    return uses


def _foreign(table: FrameTable, rows: IntArray) -> tuple[tuple[int, bool, int], ...]:
    marked = table.can_id[rows].astype(np.int64) << 1 | table.extended[rows]
    ids, counts = np.unique(marked, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:20]
    return tuple((int(ids[i]) >> 1, bool(ids[i] & 1), int(counts[i])) for i in order)


def _delay(messages: Mapping[str, Decoded], axis: TickAxis | None) -> float | None:
    """Median time from command to telemetry, where both tell their tick."""
    if axis is None:
        return None
    telemetry = [item for item in messages.values() if item.saturated]
    command = [item for item in messages.values() if _commands(item.message)]
    for later in telemetry:
        for earlier in command:
            names = later.message.name, earlier.message.name
            if names[0] == names[1] or any(name not in axis.ticks for name in names):
                continue
            _, left, right = np.intersect1d(
                axis.ticks[names[0]], axis.ticks[names[1]], return_indices=True
            )
            if len(left):
                return float(np.median(later.time_ns[left] - earlier.time_ns[right])) * 1e-9
    return None


def _commands(message: MessageMap) -> bool:
    return any(role.name.startswith("command.") for role in message.roles)


def _problems(messages: tuple[MessageReport, ...], frames: int) -> tuple[str, ...]:
    if not frames:
        return ("the bus is silent",)
    problems = []
    for item in messages:
        needed = any(role.split(".")[0] in ("channels", "command") for role in item.roles)
        good = item.received - item.crc_errors - item.length_errors
        if not item.received and needed:
            problems.append(
                f"{item.name} ({item.can_id:#x}) does not come: {', '.join(item.roles)}"
            )
        elif item.received and not good:
            why = "length" if item.length_errors else "check sum"
            problems.append(
                f"{item.name}: every frame has a wrong {why}; is the DBC the right one?"
            )
        if item.range_errors:
            problems.append(f"{item.name}: {item.range_errors} frames with values out of range")
        if too_many_conflicts(item.conflicts, good):
            problems.append(
                f"{item.name}: {item.conflicts} counter values with different payloads: a second"
                " sender"
            )
        if item.lost:
            problems.append(f"{item.name}: {item.lost} frames lost")
    return tuple(problems)


def _pauses(messages: tuple[MessageReport, ...]) -> tuple[str, ...]:
    """Silences too long for a test; a counter that turns meanwhile does not tell of them."""
    return tuple(
        f"{item.name}: nothing for {item.longest_pause:.3g} s; within a test a diagnosis bears"
        f" {MAX_SAMPLE_GAP_S:g} s"
        for item in messages
        if item.longest_pause > MAX_SAMPLE_GAP_S
        and any(role.startswith("channels.") for role in item.roles)
    )


def _unmapped(messages: Mapping[str, Decoded], frames: int) -> tuple[str, ...]:
    """What the mapping does not name of the command, and the bus does not say of oil and supply."""
    if not frames:
        return ()
    commands = "no command is mapped: the measured current has to bear out that of a stored test"
    unmapped = () if any(_commands(item.message) for item in messages.values()) else (commands,)
    stated = {
        name
        for item in messages.values()
        for name, value in item.values.items()
        if np.isfinite(value).any()
    }
    return unmapped + tuple(
        f"{name} is not on the bus: a diagnosis assumes the actuator file's"
        for name in ROLE_DIMENSIONS["environment"]
        if f"environment.{name}" not in stated
    )


def render_bus_report(report: BusReport) -> str:
    """Text of a report; the tables take 80 columns where names of messages are short."""
    width = max((len(item.name) for item in report.messages), default=7)
    lines = [
        f"{report.frames} frames in {report.duration:.2f} s, {report.errors} error frames",
        "",
        f"{'message':<{width}} {'id':>10} {'frames':>7} {'1/s':>7} {'pause ms':>8}"
        f" {'lost':>5} {'conf':>4} {'crc':>4} {'len':>4} {'range':>5}",
    ]
    for item in report.messages:
        lost = "-" if item.lost is None else str(item.lost)
        check = str(item.crc_errors) if item.crc else "-"
        lines.append(
            f"{item.name:<{width}} {item.can_id:>#10x} {item.received:>7} {item.rate:>7.1f}"
            f" {1e3 * item.longest_pause:>8.2f} {lost:>5} {item.conflicts:>4} {check:>4}"
            f" {item.length_errors:>4} {item.range_errors:>5}"
        )
    codes = [
        (f"{use.lowest_code} … {use.highest_code}", str(use.codes),
         f"{100 * (use.highest_code - use.lowest_code + 1) / use.codes:.0f} %")
        if use.lowest_code is not None and use.highest_code is not None and use.codes
        else ("-", "-", "-")
        for use in report.ranges
    ]  # fmt: skip
    wide = max((len(seen) for seen, _, _ in codes), default=0)
    wide, many = max(wide, len("codes seen")), max((len(of) for _, of, _ in codes), default=0)
    if report.ranges:
        lines += [
            "",
            f"{'channel':<8} {'codes seen':>{wide}} {'of':>{many}} {'use':>5} {'at end':>6}"
            f" {'now':>10} {'least':>10} {'most':>10}",
        ]
    for use, (seen, of, share) in zip(report.ranges, codes, strict=True):
        channel: Channel = getattr(CHANNELS, use.channel)
        unit, per_unit = channel.unit, channel.per_unit
        values = (f" {item / per_unit:>10.4g}" for item in (use.now, use.lowest, use.highest))
        first = f"{use.channel:<8} {seen:>{wide}} {of:>{many}} {share:>5} {use.saturated:>6}"
        lines.append(f"{first}{''.join(values)} {unit}")
    if report.state:
        lines += ["", report.state]
    if report.delay is not None:
        lines += ["", f"telemetry follows its command by {1e3 * report.delay:.3f} ms"]
    if report.foreign:
        listed = ", ".join(f"{number:#x} ({count})" for number, _, count in report.foreign)
        lines += ["", f"not mapped: {listed}"]
    if report.remarks:
        lines += ["", *report.remarks]
    lines += ["", *(report.problems or ("everything that a diagnosis needs is there",))]
    return "\n".join(lines)
