"""The Python page: every example runs and gives what the page says; every name is on it."""

from __future__ import annotations

import doctest
import re
import shutil
from pathlib import Path

import pytest
from places import LOGS, ROOT
from told import NearlyAsTold, as_told

import ehadiag

PAGE = ROOT / "docs" / "reference" / "python.md"
TEXT = PAGE.read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)


def test_the_page_has_its_examples() -> None:
    assert len(BLOCKS) == 9
    assert all(block.startswith(">>> ") for block in BLOCKS)


def test_every_example_gives_what_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("open", "closed"):
        shutil.copy(LOGS / f"paper-{name}-4.blf", tmp_path / f"{name}.blf")
    monkeypatch.chdir(tmp_path)
    examples = doctest.DocTestParser().get_doctest("\n".join(BLOCKS), {}, "python.md", None, 0)
    outcome = doctest.DocTestRunner(checker=NearlyAsTold()).run(examples)
    assert outcome.attempted == len(examples.examples) > 20
    assert outcome.failed == 0, capsys.readouterr().out
    assert (tmp_path / "closed.png").stat().st_size > 10_000


def test_every_public_name_is_on_the_page() -> None:
    table = TEXT.partition("## All names")[2]
    assert set(re.findall(r"`(\w+)`", table)) == set(ehadiag.__all__)


@pytest.mark.parametrize(
    ("want", "got", "same"),
    [
        ("FSS 0.6000 … 0.7\n", "FSS 0.6004 … 0.7\n", True),
        ("FSS 0.6000\n", "FSS 0.6100\n", False),
        ("FSS 0.6000 0.5\n", "FSS 0.6000\n", False),
        ("FSS 0.6\n", "FSS 0.6 0.7\n", False),
        ("5500 ticks\n", "5501 ticks\n", False),
        ("took ...\n", "took 0.123 s\n", True),
    ],
)
def test_what_counts_as_told(want: str, got: str, same: bool) -> None:
    assert as_told(want, got) is same
