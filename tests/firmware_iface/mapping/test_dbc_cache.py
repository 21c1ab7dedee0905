"""The cache of DBC contents gives the same map as the file, and never gets in the way."""

from __future__ import annotations

import os
from importlib import resources
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest
from places import ROOT

from firmware_iface import dbc
from firmware_iface.bus_map import default_map, load_map, resolve
from firmware_iface.dbc import cached_dbc, parse_dbc
from firmware_iface.files import decode_toml
from firmware_iface.mapping_file import MappingFile

DATA = resources.files("firmware_iface").joinpath("data")
TEXT = DATA.joinpath("eha_fcc.dbc").read_bytes()
PLAIN = 'VERSION ""\nBS_:\nBU_: A\nBO_ 100 M: 8 A\n SG_ S : 0|8@1+ ({scale},0) [0|0] "" A\n'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EHADIAG_CACHE_DIR", str(tmp_path))
    return tmp_path / "dbc"


@pytest.fixture
def no_parser(monkeypatch: pytest.MonkeyPatch):
    """What to call from where on nothing may be parsed any more."""

    def parse(*_):
        raise AssertionError("parsed again")

    return lambda: monkeypatch.setattr(dbc, "parse_dbc", parse)


def test_the_second_reading_is_the_first(folder: Path, no_parser) -> None:
    first = cached_dbc(TEXT, "a")
    assert first == parse_dbc(TEXT, "a")
    no_parser()
    assert cached_dbc(TEXT, "b") == first
    assert len(list(folder.iterdir())) == 1


def test_maps_from_the_cache_are_the_same(folder: Path, no_parser) -> None:
    examples = ROOT / "docs"
    mappings = [item for item in examples.rglob("*.toml") if b"mapping/1" in item.read_bytes()]
    assert mappings
    first = [default_map(), *(load_map(item) for item in mappings)]
    no_parser()
    assert [default_map(), *(load_map(item) for item in mappings)] == first


def test_another_file_is_another_entry(folder: Path) -> None:
    one, two = (PLAIN.format(scale=scale).encode() for scale in ("1", "2"))
    assert cached_dbc(one, "one")["M"].signals[0].scale == 1.0
    assert cached_dbc(two, "two")["M"].signals[0].scale == 2.0
    assert cached_dbc(one, "one")["M"].signals[0].scale == 1.0


def test_another_cantools_is_another_entry(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cached_dbc(TEXT, "a")
    monkeypatch.setattr(dbc, "find_spec", lambda _: ModuleSpec("cantools", None, origin=__file__))
    cached_dbc(TEXT, "a")
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize(
    "damage", [b"", b"{", b"[]", b'{"M": {"name": 1}}', b"\xff\xfe", b"[" * 100_000]
)
def test_a_damaged_entry_is_read_from_the_file(
    folder: Path, damage: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    first = cached_dbc(TEXT, "a")
    (entry,) = folder.iterdir()
    entry.write_bytes(damage)
    assert cached_dbc(TEXT, "a") == first
    assert entry.read_bytes() != damage
    assert caplog.text.count("\n") == 1


def test_without_a_folder_it_parses(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dbc, "private_folder", lambda _: None)
    assert cached_dbc(TEXT, "a") == parse_dbc(TEXT, "a")
    assert not folder.exists()


def test_what_cannot_be_written_is_not_kept(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = cached_dbc(TEXT, "a")
    (entry,) = folder.iterdir()
    entry.unlink()
    entry.mkdir()
    assert cached_dbc(TEXT, "a") == first
    assert [item.name for item in folder.iterdir()] == [entry.name]
    assert "the DBC is not kept" in caplog.text


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_a_planted_link_is_neither_read_nor_followed(folder: Path) -> None:
    first = cached_dbc(TEXT, "a")
    (entry,) = folder.iterdir()
    elsewhere = folder.parent / "elsewhere"
    elsewhere.write_bytes(b"{}")
    entry.unlink()
    entry.symlink_to(elsewhere)
    assert cached_dbc(TEXT, "a") == first
    assert elsewhere.read_bytes() == b"{}"
    assert not entry.is_symlink()


def test_numbers_without_end_are_not_kept(folder: Path) -> None:
    text = PLAIN.format(scale="1e999").encode()
    assert cached_dbc(text, "a")["M"].signals[0].scale == float("inf")
    assert list(folder.iterdir()) == []


def test_the_oldest_entries_go(folder: Path) -> None:
    texts = [PLAIN.format(scale=number + 1).encode() for number in range(dbc.MAX_CACHED_FILES + 3)]
    cached_dbc(texts[0], "a")
    (first,) = folder.iterdir()
    os.utime(first, (0, 0))
    for text in texts[1:]:
        cached_dbc(text, "a")
    assert len(list(folder.iterdir())) == dbc.MAX_CACHED_FILES
    assert not first.exists()


def test_only_files_are_kept(folder: Path) -> None:
    tree = decode_toml(DATA.joinpath("eha_fcc.toml").read_bytes(), MappingFile, "default")
    found = resolve(tree, parse_dbc(TEXT, "a"), "here", "eha_fcc.dbc")
    assert not folder.exists()
    assert found == default_map()
    assert folder.exists()
