"""Configuration files of others: refused in one line and at once, whatever is in them."""

from __future__ import annotations

import os
import re
import time
from importlib import resources
from pathlib import Path

import msgspec
import pytest

from ehadiag.core.actuator import Actuator, Controller, Jack, SecondStage, Servovalve, load_actuator
from ehadiag.core.errors import ConfigurationError, EhadiagError, InputOutputError
from ehadiag.core.stored_test import load_test
from ehadiag.core.toml_file import MAX_BYTES, decode_toml, read_toml

DATA = resources.files("ehadiag").joinpath("data")
STAGE = '\n[second_stage]\nkind = "orifice"\nbeta = 7.5e8\nvolume = 1.6e-4\n'
ACTUATOR = DATA.joinpath("actuator.toml").read_text() + STAGE
TEST = DATA.joinpath("tests/open.toml").read_text()
N = MAX_BYTES
HOSTILE = {
    "a key of many parts": b"a" + b".a" * (N // 2 - 2) + b"=1",
    "many keys of many parts": b"\n".join(b"[k%d" % i + b".a" * 48 + b"]" for i in range(N // 106)),
    "quoted parts": b'"a,"' + b'."a,"' * (N // 6) + b"=1",
    "parts that look like numbers": b"a" + b".1 .1" * (N // 5 - 9) + b"=1",
    "parts behind a string": b"x = {a = '''\n\"''', a" + b".a" * (N // 2 - 100) + b'= "1"}',
    "lists in lists": b"a=" + b"[" * (N // 2),
    "tables in tables": b"a=" + b"{a=" * (N // 4),
    "a long number": b"a=" + b"9" * (N - 5),
    "many keys": b"\n".join(b"k%d=1" % i for i in range(N // 9)),
    "many tables": b"[[a]]\n" * (N // 6),
    "a string without an end": b'a="' + b"\\" * (N - 10),
    "a large file": b"#" * (N + 1),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_the_parser_comes_to_an_end(case: str) -> None:
    begin = time.process_time()
    with pytest.raises(ConfigurationError) as caught:
        decode_toml(HOSTILE[case], Actuator, "here")
    assert time.process_time() - begin < 20.0, "without the limits: minutes to days"
    assert str(caught.value).startswith("here: ")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(os.name != "posix", reason="FIFOs and devices")
@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "link to a device", "null"])
def test_what_is_no_file_makes_nobody_wait(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path = Path("/dev/zero")
        case "folder":
            path.mkdir()
        case "link to a device":
            path.symlink_to("/dev/zero")
        case "null":
            path = Path("x\0y")
    with pytest.raises(InputOutputError, match=r"^actuator file .*(regular|null)"):
        load_actuator(path)


def test_an_error_quotes_nothing_of_a_file(tmp_path: Path) -> None:
    secret = tmp_path / "shadow"
    secret.write_text("root:$6$secret:19000:0:99999:7:::\n")
    (tmp_path / "link.toml").symlink_to(secret)
    with pytest.raises(ConfigurationError) as caught:
        read_toml(tmp_path / "link.toml", Actuator, "actuator file")
    assert "secret" not in str(caught.value)
    assert str(caught.value).endswith("not valid TOML at line 1, column 5")


def ranges() -> list[tuple[str, float, float]]:
    """Each number of an actuator file with its range."""
    found = []
    for part in (Controller, Servovalve, Jack, SecondStage):
        for field in msgspec.inspect.type_info(part).fields:
            if field.name != "kind":
                found.append((field.name, field.type.ge, field.type.le))
    return found


@pytest.mark.parametrize(("key", "low", "high"), ranges())
def test_numbers_beyond_what_is_built(key: str, low: float, high: float, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    for value in (1e308, -1e308, 1e-308 if low > 0 else -1e-308, high * 1.01, 10**30):
        assert low <= high
        if low <= value <= high:
            continue
        path.write_text(re.sub(rf"(?m)^{key} *=\s*\S+", f"{key} = {value!r}", ACTUATOR))
        with pytest.raises(ConfigurationError, match=rf"at `\$\.\w+\.{key}`"):
            load_actuator(path)


SPANS = ", ".join("[0.7, 1.2]" for _ in range(20_000))
TESTS = {
    "rate": ("rate = 1000.0", "rate = 1e308", "rate"),
    "low rate": ("rate = 1000.0", "rate = 1e-308", "rate"),
    "many windows": ("FDJ = ", f"FDJ = [{SPANS}]\n_ = ", "at"),
    "an endless end": ("end = 5.5", "end = 1e308", "longer than 600 s"),
    "a long test": ("end = 5.5", "end = 599.0", "599000 ticks long, need 100 to 60000"),
    "a great amplitude": ("amplitude = 8.0", "amplitude = 1e308", "amplitude"),
    "a great command": ("amplitude = 8.0", "amplitude = 9e4", "need at most 10 A"),
    "a great frequency": ("frequency = ", "frequency = 1e308 #", "beyond half the rate"),
    "a fast sine": ("frequency = ", "frequency = 501 #", "beyond half the rate"),
}


@pytest.mark.parametrize("case", TESTS)
def test_tests_without_an_end(case: str, tmp_path: Path) -> None:
    old, new, words = TESTS[case]
    assert old in TEST
    (tmp_path / "x.toml").write_text(TEST.replace(old, new, 1))
    begin = time.process_time()
    with pytest.raises(EhadiagError) as caught:
        load_test(tmp_path / "x.toml")
    assert words in str(caught.value)
    assert time.process_time() - begin < 10.0
