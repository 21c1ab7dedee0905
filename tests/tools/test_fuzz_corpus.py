"""The fuzzer's kept inputs raise nothing unexpected, and its targets notice planted errors."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from places import CORPUS

from firmware_iface import live_decode as livedecode
from firmware_iface.live_decode import LiveTicks
from firmware_iface.transport import serial_link as seriallink
from firmware_iface.transport.frames import Frame
from fuzz import native, targets


@pytest.mark.parametrize("name", targets.TARGETS)
def test_kept_inputs_still_pass(name: str) -> None:
    inputs = sorted((CORPUS / name).iterdir())
    assert inputs
    check = targets.target(name)
    for path in inputs:
        check(path.read_bytes())
    check(b"")


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler here")
def test_kept_inputs_of_the_firmware_still_pass(tmp_path: Path) -> None:
    inputs = sorted(map(str, (CORPUS / "fcc").iterdir()))
    assert inputs
    program = native.build("fcc", tmp_path, native.SANITIZERS)
    done = subprocess.run([program, *inputs], capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[0]) == len(inputs)


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler here")
def test_kept_inputs_of_a_library_still_pass(tmp_path: Path) -> None:
    inputs = sorted(map(str, (CORPUS / "onboard").iterdir()))
    assert inputs
    program = native.build("onboard", tmp_path, native.SANITIZERS)
    subprocess.run([program, *inputs], capture_output=True, check=True)


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler here")
def test_a_broken_promise_of_c_code_is_a_finding(tmp_path: Path) -> None:
    broken = '#include "native.h"\nvoid check(const uint8_t *b, size_t n)'
    (tmp_path / "broken.c").write_text(broken + '{ if (n > 2 && b[1] == 7) finding("seven"); }')
    program = native.compiled([tmp_path / "broken.c"], tmp_path / "program")
    command = [program, "1", "1000000", str(tmp_path)]
    done = subprocess.run(
        command, cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (1, b"finding: seven\n")
    assert (tmp_path / "finding.bin").read_bytes()[1] == 7


def test_the_seeds_reach_the_readers() -> None:
    frames = targets._frames_of((CORPUS / "frames" / "test").read_bytes())
    assert {item.can_id for item in frames} == {0x110, 0x111, 0x120, 0x201}
    packets = seriallink.Framer().feed((CORPUS / "serial" / "packets").read_bytes())
    assert len(packets) == 6


@pytest.mark.parametrize("name", ["logs", "mappings"])
def test_an_error_that_no_user_may_see_is_a_finding(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise IndexError

    check = targets.target(name)
    reader = {"logs": "read_recordings", "mappings": "parse_dbc"}[name]
    monkeypatch.setattr(targets, reader, broken)
    with pytest.raises(IndexError):
        check(b"\1data")


def test_a_framer_that_depends_on_the_pieces_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    feed: Callable[[seriallink.Framer, bytes], list[Frame]] = seriallink.Framer.feed

    def forgetful(self: seriallink.Framer, chunk: bytes) -> list[Frame]:
        self._partial = b""
        return feed(self, chunk)

    monkeypatch.setattr(seriallink.Framer, "feed", forgetful)
    with pytest.raises(AssertionError, match="depends"):
        targets.target("serial")((CORPUS / "serial" / "packets").read_bytes())


def test_decoders_that_disagree_are_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    data = (CORPUS / "frames" / "test").read_bytes()
    sound = livedecode._si
    monkeypatch.setattr(livedecode, "_si", lambda *given: 1.001 * sound(*given))
    with pytest.raises(AssertionError, match="disagree"):
        targets.target("frames")(data)
    monkeypatch.setattr(livedecode, "intact", lambda *_: False)
    with pytest.raises(AssertionError, match="left out"):
        targets.target("frames")(data)


def test_a_tick_that_is_given_out_twice_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    take = LiveTicks.take
    monkeypatch.setattr(LiveTicks, "take", lambda self, frame: 2 * take(self, frame))
    with pytest.raises(AssertionError, match="made up"):
        targets.target("frames")((CORPUS / "frames" / "test").read_bytes())


@pytest.mark.parametrize(("name", "last"), [("frames", "assemble"), ("logs", "read_recordings")])
def test_while_fuzzing_a_share_of_the_inputs_goes_all_the_way(
    name: str, last: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[object] = []
    monkeypatch.setattr(targets, last, lambda *given: seen.append(given))
    check = targets.target(name, share=4)
    record = (CORPUS / "frames" / "one").read_bytes()[:-1]
    for number in range(64):
        check(record + bytes((number,)))
    assert 4 <= len(seen) <= 32
