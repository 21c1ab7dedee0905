"""The glossary has every symbol of the actuator file, and its terms in order."""

from __future__ import annotations

import re
import tomllib

from places import ROOT

GLOSSARY = (ROOT / "docs" / "reference" / "glossary.md").read_text()
TERMS, SYMBOLS = GLOSSARY.split("## Symbols")


def first_cells(text: str) -> list[str]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [line.strip("|").split("|")[0].strip() for line in lines[2:]]


def test_every_symbol_of_the_actuator_file_is_explained() -> None:
    data = tomllib.loads((ROOT / "ehadiag" / "data" / "actuator.toml").read_text())
    keys = {key for part in data.values() if isinstance(part, dict) for key in part}
    explained = {name for cell in first_cells(SYMBOLS) for name in re.findall(r"`(\w+)`", cell)}
    assert keys - {"rate", "all"} - explained == set()


def test_no_symbol_is_explained_twice() -> None:
    names = [name for cell in first_cells(SYMBOLS) for name in re.findall(r"`(\w+)`", cell)]
    assert len(names) == len(set(names))


def test_terms_are_in_alphabetical_order() -> None:
    terms = [term.lower() for term in first_cells(TERMS)]
    assert terms == sorted(terms)
