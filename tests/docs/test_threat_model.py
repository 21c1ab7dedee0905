"""Each promise of the threat model names the tests that hold it, and they exist."""

from __future__ import annotations

import re

import pytest
from places import ROOT

PAGE = (ROOT / "docs/explanation/threat-model.md").read_text()
TEST = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)`")


def promises() -> list[str]:
    """Rows of the tables whose last column says which test shows them."""
    rows: list[str] = []
    inside = False
    for line in PAGE.splitlines():
        if line.startswith("| promise | how | shown by |"):
            inside = True
        elif not line.startswith("|"):
            inside = False
        elif inside and not line.startswith("| ---"):
            rows.append(line)
    return rows


PROMISES = promises()


def test_the_page_has_promises() -> None:
    assert len(PROMISES) >= 25


@pytest.mark.parametrize("row", PROMISES, ids=lambda row: row.split("|")[1].strip())
def test_a_promise_names_tests_that_exist(row: str) -> None:
    shown = row.strip(" |").split("|")[-1]
    named = TEST.findall(shown)
    assert named
    assert TEST.sub("", shown).strip(" ,") == ""
    for name, function in named:
        assert re.search(rf"^ *def {function}\(", (ROOT / name).read_text(), re.M), function
