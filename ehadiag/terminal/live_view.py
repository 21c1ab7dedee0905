"""Draws a snapshot as a terminal shows it, on 80 columns and on wider ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from ehadiag.estimate import Severity
from ehadiag.live import BusState, Residuals, RunningTest, Signals, Snapshot
from firmware_iface.errors import printable

MIN_WIDE_COLUMNS = 140
"""Columns from which on two parts stand beside each other."""
SPARK_BLOCKS = " ▁▂▃▄▅▆▇█"
ASCII_SPARK_BLOCKS = " .:-=+*#%@"
BUS_STATE_STYLES = {"open": "green", "silent": "yellow", "degraded": "yellow", "failed": "bold red"}
ENDING_STYLES = {"NO ALARM": "bold green", "ALARM": "bold red"}
BAR_COLUMNS = 20


def draw_snapshot(snapshot: Snapshot, width: int, *, unicode: bool = True) -> RenderableType:
    """Return what a console of that width prints.

    unicode: whether the terminal's encoding has block characters. Texts of others stand in it as
    text, never as markup.
    """
    monitored = snapshot.residuals is not None or snapshot.command == "monitor"
    inner = width // 2 - 4 if width >= MIN_WIDE_COLUMNS else width - 4
    parts = [_signals(snapshot.signals, inner, unicode=unicode)]
    if monitored:
        parts.append(_residuals(snapshot.residuals, inner, unicode=unicode))
    # The result of a test is printed below its last view.
    ending = snapshot.ending if snapshot.command == "monitor" else None
    beside: list[RenderableType] = []
    if snapshot.ending is None or ending is not None:
        none = "severities: none" if ending else "severities: none yet"
        severities = _severities(snapshot.severities, unicode=unicode)
        beside.append(severities if snapshot.severities else _line(none, "dim"))
    if monitored:
        beside.append(_alarms(snapshot))
    body: RenderableType
    if width >= MIN_WIDE_COLUMNS:
        body = Columns([Group(*parts), Group(*beside)], equal=True, expand=True)
    else:
        body = Group(*parts, *beside)
    rows: list[RenderableType] = [_head(snapshot), *_state(snapshot, unicode=unicode), body]
    if snapshot.ending is None and snapshot.working:
        rows.append(_line(snapshot.working, "dim"))
    rows += [_line(note, "yellow") for note in snapshot.notes]
    if ending is not None:
        rows.append(_line(ending.verdict, ENDING_STYLES.get(ending.verdict, "bold")))
        rows += [Padding(Text(printable(item)), (0, 0, 0, 2)) for item in ending.reasons]
    return Panel(Group(*rows), width=width, padding=(0, 1))


def sparkline(values: Sequence[float | None], width: int, *, unicode: bool = True) -> str:
    """Draw the newest values as blocks between the least and the most of them.

    values: None where there is none; width: characters; unicode: whether the terminal's encoding
    has block characters. Returns so many characters at most; a blank for None.
    """
    chosen = values[-width:] if width > 0 else ()
    seen = [value for value in chosen if value is not None]
    if not seen:
        return ""
    blocks = SPARK_BLOCKS if unicode else ASCII_SPARK_BLOCKS
    low, span = min(seen), max(seen) - min(seen)
    top = len(blocks) - 2
    return "".join(
        " "
        if value is None
        else blocks[1 + (round((value - low) / span * top) if span > 0.0 else top // 2)]
        for value in chosen
    )


def _line(text: str, style: str = "") -> Text:
    return Text(printable(text), style=style, no_wrap=True, overflow="ellipsis")


def _head(snapshot: Snapshot) -> RenderableType:
    serial = "unknown" if snapshot.serial is None else str(snapshot.serial)
    head = Table.grid(expand=True, padding=(0, 1))
    head.add_column(overflow="ellipsis", no_wrap=True, ratio=1)
    head.add_column(justify="right", no_wrap=True)
    left = Text.assemble(
        (f"ehadiag {snapshot.command}", "bold"),
        f"  unit {serial}  actuator ",
        printable(snapshot.actuator),
    )
    head.add_row(left, Text(f"{snapshot.time[11:19]} UTC"))
    return head


def _state(snapshot: Snapshot, *, unicode: bool) -> Iterable[RenderableType]:
    yield _bus(snapshot.bus)
    if snapshot.bus.detail:
        yield _line(f"     {snapshot.bus.detail}", "yellow")
    if snapshot.test is not None:
        yield _test(snapshot.test, snapshot.mode, unicode=unicode)


def _bus(bus: BusState) -> Text:
    rate = "" if bus.rate_per_s is None else f"  {bus.rate_per_s:.0f} frames/s"
    load = "" if bus.load is None else f"  load {bus.load:.0%}"
    lost = "" if bus.lost is None else f"  lost {bus.lost}"
    dropped = f"  dropped {bus.dropped}" if bus.dropped else ""
    text = Text.assemble(
        "bus  ",
        (bus.state, BUS_STATE_STYLES.get(bus.state, "")),
        f"{rate}{load}{lost}{dropped}  {printable(bus.name)}",
    )
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _test(test: RunningTest, mode: str | None, *, unicode: bool) -> Text:
    share = 0.0
    if test.duration_s and test.phase == "running":
        share = test.elapsed_s / test.duration_s
    bar = _bar(share, unicode=unicode, length=10) if share else ""
    left = "" if test.left_s is None else f"  {test.left_s:.1f} s left"
    name = f" {printable(test.name)}" if test.name else ""
    number = "" if test.number is None else f" ({test.number})"
    commands = "" if mode is None else f"  {mode} mode"
    text = Text.assemble("test", name, number, "  ", (test.phase, "bold"), f"  {bar}{left}")
    text.append(commands)
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _bar(share: float, *, unicode: bool, length: int = BAR_COLUMNS) -> str:
    full, empty = ("█", "·") if unicode else ("#", "-")
    done = round(min(max(share, 0.0), 1.0) * length)
    return full * done + empty * (length - done)


def _signals(signals: Signals, width: int, *, unicode: bool) -> RenderableType:
    table = Table.grid(padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, justify="right")
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    command = _latest(signals.command_mm), signals.command_mm, "mm"
    if command[0] is None:
        command = _latest(signals.command_mA), signals.command_mA, "mA"
    rows = (
        ("command", *command),
        ("current", _latest(signals.current_mA), signals.current_mA, "mA"),
        ("spool", _latest(signals.spool_mm), signals.spool_mm, "mm"),
        ("pressure", _latest(signals.pressure_MPa), signals.pressure_MPa, "MPa"),
        ("jack", _latest(signals.position_mm), signals.position_mm, "mm"),
    )
    for name, value, history, unit in rows:
        shown = "-" if value is None else f"{value:+8.4f}"
        table.add_row(name, shown, unit, sparkline(history, width - 26, unicode=unicode))
    return table


def _latest(values: Sequence[float | None]) -> float | None:
    return values[-1] if values else None


def _residuals(found: Residuals | None, width: int, *, unicode: bool) -> RenderableType:
    if found is None:
        return _line("residuals: settling", "dim")
    table = Table.grid(padding=(0, 1))
    # 54 columns of texts stand beside the bar.
    length = min(BAR_COLUMNS, max(width - 54, 0))
    for residual, name, above, below in (
        (found.spool, "spool", found.spool_above, found.spool_below),
        (found.pressure, "pressure", found.pressure_above, found.pressure_below),
    ):
        value = "   at rest" if residual is None else f"{residual:+8.1f} σ"
        high = max(above, below)
        side = "" if high == 0.0 else ", above" if above >= below else ", below"
        style = "bold red" if high >= 1.0 else ""
        table.add_row(
            Text(f"residual {name:8s}{value}"),
            Text(_bar(high, unicode=unicode, length=length), style=style),
            Text(f"{high:4.0%} of the alarm{side}", style=style),
        )
    return Group(table, _line(f"against: {found.against}", "dim")) if found.against else table


def _severities(severities: Sequence[Severity], *, unicode: bool) -> RenderableType:
    table = Table.grid(padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, overflow="ellipsis")
    for item in severities:
        std = "" if item.std is None else f" ± {item.std:.4f}"
        table.add_row(
            item.name,
            f"{item.value:.4f}{std}",
            _bar(item.value, unicode=unicode),
            Text(printable(item.source), style="dim"),
        )
    return table


def _alarms(snapshot: Snapshot) -> RenderableType:
    if not snapshot.alarm_count:
        return _line("no alarm")
    rows: list[RenderableType] = [_line(f"{snapshot.alarm_count} alarms", "bold red")]
    for alarm in snapshot.alarms[-4:]:
        during = f" during {alarm.during}" if alarm.during else ""
        recorded = f", recorded in {alarm.recorded}" if alarm.recorded else ""
        rows.append(_line(f"  {alarm.time[11:19] or alarm.time} {alarm.text}{during}{recorded}"))
    return Group(*rows)
