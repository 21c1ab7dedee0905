"""Files of recorded and modelled signals for the tools of others: MDF4 (ASAM) and MCAP.

Both hold what the picture shows: each signal as measured and as modelled, the residual in the
signal's unit and in deviations, the command, and the events of the modelled motion; the verdict as
metadata; the JSON result and the DBC as attachments.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from importlib import import_module, resources
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np

from ehadiag.core.conventions import SIGNAL_FILE_KINDS, __version__
from ehadiag.report.picture import CurveValues, Panel, PictureColumn
from ehadiag.report.response_signals import RESPONSE_SIGNALS, ResponseSignal, response_columns
from ehadiag.result import Result
from firmware_iface.errors import (
    ConfigurationError,
    InputOutputError,
    NotTestedError,
    install_command,
    printable,
)
from firmware_iface.files import MAX_DBC_BYTES, read_small_file
from firmware_iface.recording import CommandMode, Recording

LIBRARIES = {"mf4": "asammdf", "mcap": "mcap.writer"}
"""Module that writes a kind; an extra of the kind's name installs it."""
BUNDLED_DBC = "eha_fcc.dbc"
LOG_LEVELS = {"HEALTHY": 2, "DEGRADED": 3, "FAULT": 4, "NOT_TESTED": 3}
"""Level of a verdict as `foxglove.Log` counts: 2 information, 3 warning, 4 error."""


def signal_library(kind: str) -> ModuleType:
    """Return the library that writes a kind of file; ConfigurationError where it is missing."""
    try:
        return import_module(LIBRARIES[kind])
    except ImportError:
        raise ConfigurationError(
            f"signals as {kind}: need a library: {install_command(kind)}"
        ) from None


def signal_file(result: Result, kind: str) -> bytes:
    """Return recorded and modelled signals of a result as a file.

    result: with its recordings at hand; kind: one of `SIGNAL_FILE_KINDS`. ConfigurationError: the
    kind is unknown, or its library is not installed; NotTestedError: there are no samples.
    """
    if kind not in SIGNAL_FILE_KINDS:
        raise ConfigurationError(f"signals as {kind!r}: need {' or '.join(SIGNAL_FILE_KINDS)}")
    library = signal_library(kind)
    if not result.can_be_drawn:
        raise NotTestedError(f"{result.source}: no signals to write: {'; '.join(result.reasons)}")
    responses = [
        _response(recording, column) for recording, column in response_columns(result.diagnosis)
    ]
    return _mdf4(library, result, responses) if kind == "mf4" else _mcap(library, result, responses)


class _Trace(msgspec.Struct, frozen=True):
    """One quantity of a signal over time."""

    name: str
    unit: str
    values: CurveValues
    """NaN where missing."""


class _Event(NamedTuple):
    time: float
    """s from the start of the test."""
    name: str
    signal: str


class _Response(msgspec.Struct, frozen=True):
    """One recording's signals and events."""

    source: str
    start_ns: int
    """Of the test, since 1970; since the log began where it has no dates."""
    time: CurveValues
    """Start of each tick, s from the start of the test."""
    signals: dict[str, list[_Trace]]
    events: list[_Event]

    def time_ns(self, time: float) -> int:
        """Return a time of the test, s, as the log's stamps count."""
        return self.start_ns + round(time * 1e9)


def _response(recording: Recording, column: PictureColumn) -> _Response:
    samples = recording.samples
    assert samples is not None
    commanded = "position" if samples.mode is CommandMode.POSITION else "current"
    time = column.panels[0].x
    signals, events = {}, []
    for signal, panel in zip(RESPONSE_SIGNALS, column.panels, strict=True):
        recorded = getattr(samples, signal.key)[: len(time)] * signal.factor
        traces = [_Trace("measured", signal.unit, recorded), *_compared(signal, panel)]
        if signal.key == commanded:
            command = samples.command[: len(time)] * signal.factor
            traces.append(_Trace("command", signal.unit, command))
        signals[signal.key] = traces
        for curve in panel.curves[2:]:
            assert curve.x is not None
            events += [_Event(at, curve.label, signal.key) for at in curve.x.tolist()]
    return _Response(column.source, max(recording.start_ns or 0, 0), time, signals, sorted(events))


def _compared(signal: ResponseSignal, panel: Panel) -> Iterator[_Trace]:
    """Give what a recorded signal is compared with, as the recording counts."""
    if len(panel.curves) < 2 or panel.curves[1].label == "command":
        return
    name = "modelled" if panel.curves[1].label == "modelled" else "expected"
    yield _Trace(name, signal.unit, panel.curves[1].y + np.nan_to_num(panel.offset))
    residual = panel.residual
    if residual is not None:
        yield _Trace("residual", signal.small_unit, residual)
        if panel.noise:
            yield _Trace("deviation", "", 1e-3 * residual / panel.noise)


def _properties(result: Result) -> dict[str, str]:
    """Verdict, severities and origin by name."""
    out: dict[str, object] = {
        "verdict": result.verdict.name,
        "reasons": "; ".join(result.reasons),
        "test": result.test,
        "actuator": result.actuator,
        "serial": result.serial,
        "date": result.date,
        "source": result.source,
    }
    for name, item in result.as_shown.severities.items():
        low, high = item.interval95 or (None, None)
        out |= {name: item.estimate, f"{name}_std": item.std}
        out |= {f"{name}_low95": low, f"{name}_high95": high}
    out["ehadiag"] = __version__
    return {name: printable(str(value)) for name, value in out.items() if value not in (None, "")}


def _attachments(result: Result) -> Iterator[tuple[str, str, bytes]]:
    """Give name, media type and content of the result, and of the DBC where it is at hand."""
    yield "result.json", "application/json", result.to_json().encode()
    name = result.configuration.mapping.name
    if name is None or not any(item.quality.messages for item in result.recordings):
        return  # decoded signals have no DBC
    if name == BUNDLED_DBC and result.request.mapping is None and result.request.dbc is None:
        place = resources.files("firmware_iface").joinpath("data", name)
        yield name, "text/plain", place.read_bytes()
        return
    with contextlib.suppress(ConfigurationError, InputOutputError):
        content = read_small_file(Path(name), MAX_DBC_BYTES, "DBC file")
        yield Path(name).name, "text/plain", content


def _mdf4(asammdf: Any, result: Result, responses: list[_Response]) -> bytes:
    blocks = import_module("asammdf.blocks.v4_blocks")
    constants = import_module("asammdf.blocks.v4_constants")
    first = min(item.start_ns for item in responses)
    properties = _properties(result)
    out = io.BytesIO()
    with asammdf.MDF(version="4.10") as mdf:
        mdf.header.start_time = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=first / 1e3)
        mdf.header.comment = _header_comment(properties)
        for number, response in enumerate(responses):
            begin = (response.start_ns - first) * 1e-9
            mdf.append(
                [
                    asammdf.Signal(
                        trace.values, response.time + begin, trace.unit, f"{key}.{trace.name}"
                    )
                    for key, traces in response.signals.items()
                    for trace in traces
                ],
                acq_name=f"recording {number + 1}",
                comment=response.source,
                common_timebase=True,
            )
            for event in response.events:
                block = blocks.EventBlock(
                    event_type=constants.EVENT_TYPE_MARKER, sync_base=round(event.time * 1e9)
                    + response.start_ns - first, sync_factor=1e-9, scope_0_addr=0,
                )  # fmt: skip
                block.name, block.comment = event.name, event.signal
                block.scopes.append(number)
                mdf.events.append(block)
        for name, media_type, content in _attachments(result):
            mdf.attach(content, name, mime=media_type)
        mdf.save(out, compression=2)
    return out.getvalue()


def _header_comment(properties: dict[str, str]) -> str:
    """Write properties as the comment of an MDF header."""
    root = ElementTree.Element("HDcomment")
    ElementTree.SubElement(root, "TX").text = f"{properties['verdict']}: {properties['source']}"
    common = ElementTree.SubElement(root, "common_properties")
    for name, value in properties.items():
        ElementTree.SubElement(common, "e", name=name).text = value
    return ElementTree.tostring(root, encoding="unicode")


def _mcap(mcap: Any, result: Result, responses: list[_Response]) -> bytes:
    out = io.BytesIO()
    writer = mcap.Writer(out)
    writer.start(profile="", library=f"ehadiag {__version__}")
    first = min(item.start_ns for item in responses)
    properties = _properties(result)
    log = writer.register_schema("foxglove.Log", "jsonschema", json.dumps(LOG_SCHEMA).encode())
    for number, response in enumerate(responses):
        prefix = "" if number == 0 else f"/{number + 1}"
        events = writer.register_channel(f"{prefix}/events", "json", log)
        text = f"{properties['verdict']}. {properties.get('reasons', '')}"
        messages = [
            (response.start_ns, events, _log(LOG_LEVELS[properties["verdict"]], text, "verdict"))
        ]
        messages += [
            (response.time_ns(item.time), events, _log(2, item.name, item.signal))
            for item in response.events
        ]
        times = [response.time_ns(item) for item in response.time.tolist()]
        for key, traces in response.signals.items():
            schema = writer.register_schema(
                f"ehadiag.{key}", "jsonschema", json.dumps(_schema(key, traces)).encode()
            )
            channel = writer.register_channel(f"{prefix}/{key}", "json", schema)
            names = [_field(item) for item in traces]
            rows = np.column_stack([item.values for item in traces]).tolist()
            for at, row in zip(times, rows, strict=True):
                values = {
                    name: value
                    for name, value in zip(names, row, strict=True)
                    if math.isfinite(value)
                }
                messages.append((at, channel, values))
        for at, channel, content in sorted(messages, key=lambda item: item[0]):
            if channel == events:
                content["timestamp"] = {"sec": at // 10**9, "nsec": at % 10**9}
            writer.add_message(channel, at, json.dumps(content).encode(), at)
    writer.add_metadata("ehadiag", properties)
    for name, media_type, data in _attachments(result):
        writer.add_attachment(first, first, name, media_type, data)
    writer.finish()
    return out.getvalue()


def _field(trace: _Trace) -> str:
    """Name of a quantity with its unit, such as `residual_um`."""
    return f"{trace.name}_{trace.unit.replace('µ', 'u')}".removesuffix("_")


def _schema(key: str, traces: list[_Trace]) -> dict[str, Any]:
    fields = {
        _field(item): {"type": "number", "description": f"{item.name}, {item.unit or 'noise'}"}
        for item in traces
    }
    return {"title": f"ehadiag.{key}", "type": "object", "properties": fields}


def _log(level: int, message: str, name: str) -> dict[str, Any]:
    return {"level": level, "message": message, "name": name, "file": "", "line": 0}


LOG_SCHEMA = {
    "title": "foxglove.Log",
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {
                "sec": {"type": "integer", "minimum": 0},
                "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
            },
        },
        "level": {"title": "foxglove.LogLevel", "type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer", "minimum": 0},
    },
}
"""What Foxglove's Log panel shows."""
