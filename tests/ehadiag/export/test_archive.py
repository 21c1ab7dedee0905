"""Static libraries and object files as tools of others read them."""

import shutil
import struct
import subprocess

import pytest

from ehadiag.export.targets import mark_either_convention, static_library


def test_members_begin_at_even_places():
    made = static_library("odd.o", b"123", ["a", "bc"])
    place = int.from_bytes(made[72:76], "big")
    assert made[:8] == b"!<arch>\n"
    assert place % 2 == 0
    assert made[place : place + 16] == b"odd.o/".ljust(16)
    assert made[place + 60 : place + 63] == b"123"
    assert len(made) % 2 == 0


def test_name_too_long():
    with pytest.raises(ValueError, match="too long"):
        static_library("a_name_of_sixteen.o", b"", [])


@pytest.mark.skipif(shutil.which("ar") is None, reason="no ar here")
def test_ar_lists_it(tmp_path):
    (tmp_path / "x.a").write_bytes(static_library("x.o", b"12345", ["symbol"]))
    listed = subprocess.run(["ar", "t", tmp_path / "x.a"], capture_output=True, check=True)
    assert listed.stdout == b"x.o\n"


def arm_object(attributes):
    head = b"\x7fELF\x01\x01".ljust(32, b"\0") + struct.pack("<I", 52)
    head = head.ljust(46, b"\0") + struct.pack("<HH", 40, 1)
    section = struct.pack("<6I", 0, 0x70000003, 0, 0, 92, len(attributes)).ljust(40, b"\0")
    return head.ljust(52, b"\0") + section + attributes


def test_arm_object_is_marked_in_its_attributes_alone():
    made = mark_either_convention(arm_object(b"A\x26\x01\x0e\x00") + b"\x26\x01")
    assert made.endswith(b"A\x1c\x03\x0e\x00\x26\x01")


def test_arm_object_without_a_place_is_refused():
    with pytest.raises(ValueError, match="not found"):
        mark_either_convention(arm_object(b"A\x0e\x00"))


def test_others_are_left():
    assert mark_either_convention(b"\x7fELF\x02\x01 and so on") == b"\x7fELF\x02\x01 and so on"
