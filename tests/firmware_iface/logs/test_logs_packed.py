"""Logs packed by gzip: the same recording, and every way in which the packing can be wrong."""

from __future__ import annotations

import gzip
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from places import LOGS

from ehadiag import InputOutputError
from firmware_iface.logs.log_files import unpacked_log
from firmware_iface.logs.reader import read_frames
from firmware_iface.signals.recordings import read_recording

LOG = LOGS / "paper-open-1.blf"


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where logs are unpacked; nothing may be left there."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def packed(source: Path, target: Path) -> Path:
    with source.open("rb") as plain, gzip.open(target, "wb") as out:
        shutil.copyfileobj(plain, out)
    return target


@pytest.mark.parametrize("name", ["paper-open-1.blf", "hot-worn-closed.asc"])
def test_the_same_recording(name: str, tmp_path: Path, temporary: Path) -> None:
    path = packed(LOGS / name, tmp_path / f"{name.upper()}.gz")
    found, original = read_recording(path), read_recording(LOGS / name)
    assert found.source == str(path)
    assert found.quality == original.quality
    assert found.samples is not None
    assert original.samples is not None
    np.testing.assert_array_equal(found.samples.spool, original.samples.spool)
    np.testing.assert_array_equal(found.samples.host_ns, original.samples.host_ns)
    assert list(temporary.iterdir()) == []


def test_one_that_breaks_off_is_read_up_to_the_break(tmp_path: Path) -> None:
    path = packed(LOG, tmp_path / "cut.blf.gz")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    recording = read_recording(path)
    assert recording.samples is not None
    assert 500 < recording.samples.ticks < 5500
    assert any("the packed log breaks off" in note for note in recording.quality.notes)


def test_what_is_wrong_names_the_packed_log(tmp_path: Path, temporary: Path) -> None:
    cases = {
        "text.blf.gz": (b"hello, world", "not packed by gzip"),
        "other.blf.gz": (gzip.compress(b"hello, world" * 20), "not a BLF file"),
        "empty.blf.gz": (gzip.compress(b""), "the file is empty"),
        "short.log.gz": (gzip.compress(b"(1.0) can0 123#0\n"), "no frames in it"),
    }
    for name, (content, why) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputOutputError) as error:
            read_frames(tmp_path / name)
        assert str(error.value).startswith(f"log {tmp_path / name}: ")
        assert why in str(error.value)
        assert str(temporary) not in str(error.value)
    assert list(temporary.iterdir()) == []


def test_a_bomb_is_not_unpacked(tmp_path: Path, temporary: Path) -> None:
    path = tmp_path / "bomb.log.gz"
    path.write_bytes(gzip.compress(bytes(40 << 20)))
    why = r"bomb\.log\.gz: unpacks to more than 4 MiB"
    with pytest.raises(InputOutputError, match=why), unpacked_log(path, 4 << 20):
        pass
    assert list(temporary.iterdir()) == []
