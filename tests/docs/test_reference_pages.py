"""The glossary has each symbol once, and its terms in order.

Every schema that a command prints stands in the reference, with all keys. Figures of the
specification's pages against the data that the programs use.
"""

from __future__ import annotations

import itertools
import json
import re
import runpy
from collections import Counter
from enum import IntEnum
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from cantools.database.can import Message
from history_cases import an_entry, an_event
from places import ROOT

from ehadiag import bundled_tests
from ehadiag.cli.main import main
from ehadiag.estimate import Severity
from ehadiag.history.store import History
from ehadiag.live import Alarm, BusState, Ending, Residuals, RunningTest, Snapshot
from ehadiag.model.registry import REGISTRY
from ehadiag_tools.accuracy.cases import PAPER
from firmware_iface.bus_report import BusReport, MessageReport, RangeUse
from firmware_iface.recording import CHANNELS, BitReason, BitState, OnboardState
from firmware_iface.uds.services import DATA_RECORDS, TROUBLE_CODES

GLOSSARY = (ROOT / "docs" / "reference" / "glossary.md").read_text()
TERMS, SYMBOLS = GLOSSARY.split("## Symbols")


def first_cells(text: str) -> list[str]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [line.strip("|").split("|")[0].strip() for line in lines[2:]]


def test_no_symbol_is_explained_twice() -> None:
    """Those of the actuator's data are explained by its file's page (test_cli_docs)."""
    page = (ROOT / "docs" / "reference" / "actuator-file.md").read_text()
    names = [name for cell in first_cells(SYMBOLS) for name in re.findall(r"`(\w+)`", cell)]
    data = re.findall(r"^\| `(?:controller|servovalve|jack)\.(\w+)`", page, re.MULTILINE)
    assert len(data) > 25
    assert {name for name, count in Counter(names + data).items() if count > 1} == set()


def test_terms_are_in_alphabetical_order() -> None:
    terms = [term.lower() for term in first_cells(TERMS)]
    assert terms == sorted(terms)


def as_on_the_site(page: str) -> str:
    """A page with the tables that are made from the code."""
    text = (ROOT / "docs" / "reference" / page).read_text("utf-8")
    return str(runpy.run_path(str(ROOT / "docs" / "conf.py"))["with_tables"](text))


def test_the_site_has_every_parameter_of_the_registry() -> None:
    names = {cell.strip("`") for cell in first_cells(as_on_the_site("parameters.md"))}
    data = {item.name for item in REGISTRY if item.name == f"datum_{item.symbol.lstrip('d')}"}
    assert names == {item.name for item in REGISTRY} - data | {"datum_NAME"}


def test_the_site_has_every_service_of_uds() -> None:
    page = as_on_the_site("uds.md")
    assert all(f"22 {item.number:04X}" in page for item in DATA_RECORDS.values())
    assert all(f"{item.number:06X}" in page for item in TROUBLE_CODES)


REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "reference" / "json.md").read_text()


def missing(section: str, keys: set[str]) -> set[str]:
    """Keys that a section of the page does not name."""
    text = PAGE.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    return {key for key in keys if f"`{key}`" not in text} - {"schema"}


def keys_of(tree: Any) -> set[str]:
    """Return all keys of objects in a tree, names of severities and effects not among them."""
    if isinstance(tree, list):
        return set().union(*map(keys_of, tree))
    if not isinstance(tree, dict):
        return set()
    names = {"Kintas", "FSS", "FDJ", "null_bias"}
    below = (keys_of(value) for key, value in tree.items() if key != "result")
    return (set(tree) - names).union(*below)


def test_every_schema_is_named() -> None:
    sources = [*(REPOSITORY / "ehadiag").rglob("*.py")]
    schemas = {
        name
        for path in sources
        for name in re.findall(
            r'^[A-Z_]*SCHEMA[^=\n]*= "(ehadiag\.[a-z]+/\d)"', path.read_text(), re.M
        )
    }
    assert len(schemas) >= 6
    assert {name for name in schemas if name not in PAGE} == set()


@pytest.mark.parametrize(
    ("section", "kinds"),
    [
        ("Live view", (Snapshot, BusState, RunningTest, Residuals, Alarm, Severity, Ending)),
        ("Check of a bus", (BusReport, MessageReport, RangeUse)),
    ],
)
def test_every_field_is_named(section: str, kinds: tuple[type[Any], ...]) -> None:
    fields = {name for kind in kinds for name in kind.__struct_fields__}
    assert missing(section, fields) == set()


def test_history_and_remaining_life_are_described(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = str(tmp_path / "h.sqlite")
    with History(Path(place), create=True) as history:
        history.append(an_entry(hours=10.0))
        history.append_event(an_event())
    for section, words in (
        ("Health history", ("history", "list", "--json")),
        ("Health history", ("history", "show", "1")),
        ("Remaining life", ("rul", "--unit", "7", "--json")),
    ):
        assert main([*words, "--history", place]) == 0
        said = capsys.readouterr().out
        trees = [json.loads(said)] if words[1] == "show" else map(json.loads, said.splitlines())
        assert missing(section, keys_of(list(trees))) == set()


REFERENCE = ROOT / "docs" / "reference"


def requirement(number: str) -> str:
    """Text of one requirement: up to the next one or the next heading."""
    page = "physics.md" if number.startswith("PHY") else "bus.md"
    text = (REFERENCE / page).read_text()
    match = re.search(
        rf"^\*\*{number} [^*]+\.\*\*(.*?)(?=^\*\*(?:PHY|BUS)-|^#|\Z)",
        text,
        re.DOTALL | re.MULTILINE,
    )
    assert match
    return match.group(1)


def rows(number: str) -> list[list[str]]:
    """Cells of a requirement's table, without its head."""
    lines = [line for line in requirement(number).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


@pytest.fixture(scope="module")
def messages() -> dict[str, Message]:
    database = cantools.database.load_file(ROOT / "firmware_iface" / "data" / "eha_fcc.dbc")
    return {message.name: message for message in database.messages}


def test_ranges_are_those_of_the_converters_and_of_the_bus(messages: dict[str, Message]) -> None:
    signals = messages["ServoTelemetry"].signals[:4]
    for channel, signal, (_, span, lsb) in zip(CHANNELS, signals, rows("PHY-23"), strict=True):
        half, unit = re.fullmatch(r"±([\d.]+) (\w+)", span).groups()  # type: ignore[union-attr]
        width = re.fullmatch(rf"(\d+)/4096 {unit}", lsb).group(1)  # type: ignore[union-attr]
        assert channel.unit == unit == signal.unit
        assert channel.full_scale / channel.per_unit == pytest.approx(float(half))
        assert channel.lsb / channel.per_unit == pytest.approx(int(width) / 4096)
        assert signal.scale == pytest.approx(int(width) / 4096)
        assert 2.0**signal.length == channel.levels


@pytest.mark.parametrize(
    ("number", "name", "code"), [("PHY-25", "open", 1), ("PHY-26", "closed", 2)]
)
def test_stored_tests_are_the_specified_ones(number: str, name: str, code: int) -> None:
    test = bundled_tests()[name]
    unit = 1e-3
    assert (test.id, test.ticks, test.rate) == (code, 5500, 1000.0)
    line, *sines = rows(number)
    time = np.arange(test.ticks) / test.rate
    expected = np.zeros(test.ticks)
    for span, formula in sines:
        start, end = (float(part) for part in re.findall(r"\d+\.\d+", span))
        match = re.fullmatch(r"`(\d+)·sin\(2π·(\d+)·\(t − (\d\.\d)\)\)`", formula)
        assert match
        amplitude, frequency, origin = (float(part) for part in match.groups())
        inside = (time > start + 1e-9) & (time < end + 1e-9)
        expected[inside] = amplitude * np.sin(2 * np.pi * frequency * (time[inside] - origin))
    # Corners as (time, value); "step to v" repeats the time before it, "(t)" the value before it.
    corners: list[tuple[float, float]] = []
    text = line[1].replace("−", "-")
    for pair, single, step in re.findall(
        r"\(([-\d.]+, [-\d.]+)\)|\(([\d.]+)\)|step to ([-\d.]+)", text
    ):
        if pair:
            at, value = (float(part) for part in pair.split(","))
        elif single:
            at, value = float(single), corners[-1][1]
        else:
            at, value = corners[-1][0], float(step)
        corners.append((at, value))
    for (t0, v0), (t1, v1) in itertools.pairwise(corners):
        inside = (time > t0 + 1e-9) & (time < t1 + 1e-9)  # a tick at a step has the earlier value
        if t1 > t0:
            expected[inside] = v0 + (v1 - v0) * (time[inside] - t0) / (t1 - t0)
    assert test.command() / unit == pytest.approx(expected, abs=1e-9)


def test_the_papers_figures_are_those_of_the_tools() -> None:
    found = [
        (test, tuple(float(part) for part in truth.split(",")), float(first), float(final))
        for test, truth, first, final in rows("PHY-40")
    ]
    assert found == [(case.test, case.faults, case.first, case.final) for case in PAPER]
    for test, mean in (("open", "0.310"), ("closed", "0.279")):
        finals = [final for name, _, _, final in found if name == test]
        assert f"{sum(finals) / len(finals):.3f}" == mean
        assert f"{mean} % in {test}" in requirement("PHY-40").replace("\n", " ")


def test_messages_are_those_of_the_database(messages: dict[str, Message]) -> None:
    table = rows("BUS-4")
    assert {name.strip("`") for name, *_ in table} == set(messages)
    for name, identifier, sender, rate, _ in table:
        message = messages[name.strip("`")]
        assert message.frame_id == int(identifier, 16)
        assert message.senders == [{"tester": "TESTER"}.get(sender, sender)]
        cycle = message.cycle_time
        periods = {"1 kHz": 1, "10 Hz": 100, "50 Hz and on change": 20}
        assert cycle == periods.get(rate), name


@pytest.mark.parametrize(
    ("number", "message", "signal", "kind"),
    [
        ("BUS-10", "BitStatus", "BitState", BitState),
        ("BUS-11", "BitStatus", "BitReason", BitReason),
        ("BUS-17", "OnboardVerdict", "OnboardState", OnboardState),
    ],
)
def test_states_and_reasons_are_those_of_the_bus(
    number: str,
    message: str,
    signal: str,
    kind: type[IntEnum],
    messages: dict[str, Message],
) -> None:
    choices = messages[message].get_signal_by_name(signal).choices
    assert choices is not None
    assert set(choices) == {int(item) for item in kind}
    said = {int(code) for code in re.findall(r"\b(\d) [a-z]", requirement(number))}
    assert said | {0} == set(choices)
