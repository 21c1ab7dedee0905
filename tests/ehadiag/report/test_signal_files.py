"""MDF4 and MCAP files of a result, as asammdf and mcap read them."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import asammdf
import numpy as np
import pytest
from mcap.reader import make_reader
from msgspec.structs import replace
from places import LOGS, ROOT

import ehadiag
from ehadiag.core.conventions import SIGNAL_FILE_KINDS
from ehadiag.report.response_signals import RESPONSE_SIGNALS, response_columns
from ehadiag.result import Result
from firmware_iface.errors import ConfigurationError, NotTestedError

WORN = LOGS / "paper-closed-4.blf"
LAYOUTS = ROOT / "examples" / "layouts"
DBC = (ROOT / "firmware_iface" / "data" / "eha_fcc.dbc").read_bytes()


def read_mdf4(path: Path) -> tuple[Any, ...]:
    """Channels of each group, events, attachments, properties and start of a file, by asammdf."""
    with asammdf.MDF(path) as mdf:
        groups = [
            {c.name: (c.unit, mdf.get(c.name, group=n).samples) for c in group.channels}
            for n, group in enumerate(mdf.groups)
        ]
        events = [(e.value, e.name, e.comment, tuple(e.scopes)) for e in mdf.events]
        attached = {
            str(a.file_name): mdf.extract_attachment(n)[0].decode()
            for n, a in enumerate(mdf.attachments)
        }
        properties = dict(mdf.header._common_properties)
        return groups, events, attached, properties, mdf.header.start_time.timestamp()


def read_mcap(path: Path) -> tuple[Any, ...]:
    """Messages of each topic, attachments and metadata of a file, by mcap."""
    topics: dict[str, Any] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            fields = list(json.loads(schema.data)["properties"])
            topic = topics.setdefault(channel.topic, (schema.name, fields, []))
            topic[2].append((message.log_time, json.loads(message.data)))
        attached = {item.name: item.data.decode() for item in reader.iter_attachments()}
        return topics, attached, {item.name: item.metadata for item in reader.iter_metadata()}


@lru_cache(maxsize=1)
def worn() -> Result:
    return ehadiag.diagnose(WORN)


@lru_cache(maxsize=1)
def mismodelled() -> Result:
    """A result whose model has to be put back on the measured spool, for its friction is wrong."""
    diagnosis = worn().diagnosis
    found = diagnosis.identification
    assert found is not None
    wrong = tuple(
        replace(item, value=0.0) if item.name == "FSS" else item for item in found.estimates
    )
    return worn().with_diagnosis(replace(diagnosis, identification=replace(found, estimates=wrong)))


def expected_events(result: Result) -> list[tuple[float, str, str]]:
    """Events that the picture marks."""
    return sorted(
        (at, curve.label, signal.key)
        for _, column in response_columns(result.diagnosis)
        for signal, panel in zip(RESPONSE_SIGNALS, column.panels, strict=True)
        for curve in panel.curves[2:]
        if curve.x is not None
        for at in curve.x.tolist()
    )


def check_values(values: dict[str, Any], result: Result, unit_of: dict[str, str]) -> None:
    """Compare `signal.quantity` arrays of a file with what the result has at hand."""
    samples = result.recordings[0].samples
    (experiment,), fit = result.diagnosis.experiments, result.diagnosis.identification
    assert samples is not None
    assert fit is not None
    ((_, column),) = response_columns(result.diagnosis)
    noises = (None, *experiment.noise)
    for signal, panel, noise in zip(RESPONSE_SIGNALS, column.panels, noises, strict=True):
        recorded = getattr(samples, signal.key) * signal.factor
        np.testing.assert_array_equal(values[f"{signal.key}.measured"], recorded)
        gap = np.array(values[f"{signal.key}.measured"]) - values[f"{signal.key}.modelled"]
        residual = np.array(values[f"{signal.key}.residual"])
        np.testing.assert_allclose(1e3 * gap, residual, atol=1e-9)
        np.testing.assert_array_equal(residual, panel.residual)
        if noise is not None:
            deviation = 1e-3 * residual / (noise * signal.factor)
            np.testing.assert_allclose(values[f"{signal.key}.deviation"], deviation, rtol=1e-12)
        assert unit_of[f"{signal.key}.measured"] == signal.unit
        assert unit_of[f"{signal.key}.residual"] == signal.small_unit
    np.testing.assert_array_equal(values["position.command"], 1e3 * samples.command)
    assert np.std(values["spool.deviation"]) == pytest.approx(fit.fit.spool_rms, rel=0.1)


@pytest.mark.parametrize("result", [worn, mismodelled])
def test_asammdf_reads_signals_events_and_attachments(result: Any, tmp_path: Path) -> None:
    found = result()
    found.write_signals(tmp_path / "test.mf4")
    (group,), events, attached, properties, start = read_mdf4(tmp_path / "test.mf4")
    if result is worn:
        check_values(
            {k: v for k, (_, v) in group.items()}, found, {k: u for k, (u, _) in group.items()}
        )
    assert [(at, name, signal) for at, name, signal, _ in events] == [
        (pytest.approx(at, abs=1e-9), name, signal) for at, name, signal in expected_events(found)
    ]
    assert all(scopes == (0,) for *_, scopes in events)
    names = {name for _, name, _, _ in events}
    assert "break-away" in names
    assert ("re-anchoring" in names) is (result is mismodelled)
    assert attached["eha_fcc.dbc"].encode() == DBC
    assert Result.from_json(attached["result.json"]) == found
    assert properties["verdict"] == "DEGRADED"
    assert float(properties["FSS"]) == found.severities["FSS"].estimate
    assert start == pytest.approx((found.recordings[0].start_ns or 0) / 1e9, abs=2e-6)


def test_mcap_reads_what_foxglove_plots(tmp_path: Path) -> None:
    found, path = worn(), tmp_path / "test.mcap"
    found.write_signals(path)
    topics, attached, metadata = read_mcap(path)
    units = {"uA": "µA", "um": "µm"}
    values, unit_of, begin = {}, {}, found.recordings[0].start_ns
    for signal in RESPONSE_SIGNALS:
        name, fields, messages = topics[f"/{signal.key}"]
        assert name == f"ehadiag.{signal.key}"
        assert [at for at, _ in messages] == [begin + k * 1_000_000 for k in range(len(messages))]
        for field in fields:
            quantity, _, unit = field.partition("_")
            values[f"{signal.key}.{quantity}"] = [item.get(field, np.nan) for _, item in messages]
            unit_of[f"{signal.key}.{quantity}"] = units.get(unit, unit)
    check_values(values, found, unit_of)
    name, _, log = topics["/events"]
    assert name == "foxglove.Log"
    assert (log[0][1]["level"], log[0][1]["name"]) == (3, "verdict")
    assert [(at, item["message"], item["name"]) for at, item in log[1:]] == [
        (begin + round(at * 1e9), event, signal) for at, event, signal in expected_events(found)
    ]
    for at, item in log:
        assert item["timestamp"]["sec"] * 10**9 + item["timestamp"]["nsec"] == at
    assert attached["eha_fcc.dbc"].encode() == DBC
    assert Result.from_json(attached["result.json"]) == found
    assert metadata["ehadiag"]["verdict"] == "DEGRADED"


def panels_of(node: Any) -> Iterator[str]:
    """Panels that a Foxglove layout shows."""
    if isinstance(node, str):
        yield node
    else:
        yield from panels_of(node["first"])
        yield from panels_of(node["second"])


def test_layouts_name_signals_that_a_file_has(tmp_path: Path) -> None:
    worn().write_signals(tmp_path / "closed.mcap")
    ehadiag.diagnose(LOGS / "paper-open-4.blf").write_signals(tmp_path / "open.mcap")
    topics, known = set(), set()
    for name in ("closed.mcap", "open.mcap"):  # the command is another signal's in each
        with (tmp_path / name).open("rb") as file:
            summary = make_reader(file).get_summary()
        for number in summary.statistics.channel_message_counts:
            channel = summary.channels[number]
            topics.add(channel.topic)
            fields = json.loads(summary.schemas[channel.schema_id].data)["properties"]
            known |= {f"{channel.topic}/{field}" for field in fields}
    foxglove = json.loads((LAYOUTS / "foxglove.json").read_text())
    panels = foxglove["configById"]
    assert sorted(panels_of(foxglove["layout"])) == sorted(panels)
    paths = {
        path["value"].replace(".", "/")
        for panel in panels.values()
        for path in panel.get("paths", ())
    }
    root = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
    curves = {item.attrib["name"] for item in root.iter("curve")}
    assert paths <= known
    assert curves <= known
    measured = {f"/{item.key}/measured_{item.unit}" for item in RESPONSE_SIGNALS}
    assert measured <= paths & curves
    assert panels["Log!events"]["topicToRender"] in topics


def test_recordings_of_a_joint_result_keep_their_times(tmp_path: Path) -> None:
    joint = ehadiag.diagnose([LOGS / "paper-open-4.blf", WORN])
    joint.write_signals(tmp_path / "joint.mf4")
    joint.write_signals(tmp_path / "joint.mcap")
    groups, events, *_ = read_mdf4(tmp_path / "joint.mf4")
    assert [len(group["time"][1]) for group in groups] == [5500, 5500]
    assert {scopes for *_, scopes in events} == {(0,), (1,)}
    topics, *_ = read_mcap(tmp_path / "joint.mcap")
    starts = [item.start_ns or 0 for item in joint.recordings]
    assert [topics[f"{name}/spool"][2][0][0] for name in ("", "/2")] == starts
    first = min(starts)
    assert [group["time"][1][0] for group in groups] == [
        pytest.approx((start - first) * 1e-9) for start in starts
    ]


def test_without_an_estimate_the_response_of_a_unit_as_new_is_written(tmp_path: Path) -> None:
    half = tmp_path / "half.blf"
    content = WORN.read_bytes()
    half.write_bytes(content[: len(content) // 2])
    result = ehadiag.diagnose(half)
    assert not result.identified
    result.write_signals(tmp_path / "half.mf4")
    (group,), events, _, properties, _ = read_mdf4(tmp_path / "half.mf4")
    assert {"spool.measured", "spool.expected", "spool.residual"} <= set(group)
    assert "spool.deviation" not in group
    assert (events, properties["verdict"]) == ([], "NOT_TESTED")


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match="need mf4 or mcap"):
        worn().write_signals(tmp_path / "test.csv")
    stored = Result.from_json(worn().to_json())
    with pytest.raises(NotTestedError, match="no signals to write"):
        stored.write_signals(tmp_path / "test.mf4")
    for kind, module in zip(SIGNAL_FILE_KINDS, ("asammdf", "mcap.writer"), strict=True):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ConfigurationError, match=r"need a library: .*install"):
            worn().write_signals(tmp_path / f"test.{kind}")
    assert list(tmp_path.iterdir()) == []
