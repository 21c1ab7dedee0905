"""Every requirement has one number, one definition, code that meets it and a test that shows it."""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from places import ROOT

REFERENCE = ROOT / "docs" / "reference"
PAGES = {"PHY": REFERENCE / "physics.md", "BUS": REFERENCE / "bus.md"}
NUMBER = re.compile(r"\b(?:PHY|BUS)-\d+\b")
TABLE = (REFERENCE / "traceability.md").read_text()
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TABLE.splitlines()
    if line.startswith("| ") and not line.startswith(("| requirement", "| promise", "| ---"))
]


def definitions(family: str) -> list[str]:
    """Numbers that a page defines, in its order: a paragraph that begins with one in bold."""
    return re.findall(
        rf"^\*\*({family}-\d+) [^*\n]+\.\*\*", PAGES[family].read_text(), re.MULTILINE
    )


DEFINED = {number for family in PAGES for number in definitions(family)}


@pytest.mark.parametrize("family", PAGES)
def test_requirements_are_numbered_from_one_without_gaps(family: str) -> None:
    found = definitions(family)
    assert found == [f"{family}-{i}" for i in range(1, len(found) + 1)]
    assert found


def test_every_requirement_has_a_row_of_its_own() -> None:
    rows = Counter(number for row in ROWS for number in NUMBER.findall(row[0]))
    assert set(rows) == DEFINED
    assert {number for number, count in rows.items() if count > 1} == set()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_row_names_code_and_tests_that_exist(row: list[str]) -> None:
    _, module, shown = row
    modules = re.findall(r"`([\w./-]+)`", module)
    tests = re.findall(r"`([\w./-]+)`", shown)
    assert modules
    assert any(name.startswith("tests/") for name in tests)
    for name in modules + tests:
        assert (ROOT / name).exists(), name


def test_a_cited_requirement_is_defined() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split("\0")
    if listed == [""]:  # an archive without git
        listed = [str(p.relative_to(ROOT)) for p in ROOT.rglob("*") if p.is_file()]
    kinds = {".py", ".md", ".toml", ".c", ".h"}
    unknown, citing = {}, 0
    for name in listed:
        path = ROOT / name
        if Path(name).suffix in kinds and path.is_file():
            cited = set(NUMBER.findall(path.read_text(errors="replace")))
            citing += bool(cited)
            if cited - DEFINED:
                unknown[name] = cited - DEFINED
    assert unknown == {}
    assert citing > 50
