"""Every schema that a command prints stands in the reference, with all keys."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
from history_cases import an_entry, an_event

from ehadiag.cli.main import main
from ehadiag.history.store import History
from ehadiag.live.snapshot import Alarm, Bus, Ending, Residuals, RunningTest, Severity, Snapshot
from firmware_iface.session.bus_report import BusReport, MessageReport, RangeUse

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "json.md").read_text()


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
    sources = [*(ROOT / "ehadiag").rglob("*.py")]
    schemas = {
        name
        for path in sources
        for name in re.findall(r'^SCHEMA[^=\n]*= "(ehadiag\.[a-z]+/\d)"', path.read_text(), re.M)
    }
    assert len(schemas) >= 6
    assert {name for name in schemas if name not in PAGE} == set()


@pytest.mark.parametrize(
    ("section", "kinds"),
    [
        ("Live view", (Snapshot, Bus, RunningTest, Residuals, Alarm, Severity, Ending)),
        ("Check of a bus", (BusReport, MessageReport, RangeUse)),
    ],
)
def test_every_field_is_named(section: str, kinds: tuple[type[Any], ...]) -> None:
    fields = {item.name for kind in kinds for item in dataclasses.fields(kind)}
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
        ("Remaining life", ("rul", "--serial", "7", "--json")),
    ):
        assert main([*words, "--history", place]) == 0
        said = capsys.readouterr().out
        trees = [json.loads(said)] if words[1] == "show" else map(json.loads, said.splitlines())
        assert missing(section, keys_of(list(trees))) == set()
