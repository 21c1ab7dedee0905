"""Shared libraries out of one object file, for Linux, without a linker (ELF-64, System V ABI).

The code of kernels is independent of its place, changes no data of its own, and calls nothing
outside. So all of it is one segment whose references are known when the library is made; the loader
has nothing to do but to find the names. What would need more is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum, IntFlag
from typing import NamedTuple

PAGE = 0x10000
"""Alignment of segments, bytes: the largest page of AArch64."""
HEADER, PROGRAM, SECTION, SYMBOL = "<16sHHIQQQIHHHHHH", "<IIQQQQQQ", "<IIQQQQIIQQ", "<IBBHQQ"
FIXED_TAGS = {"hash": 4, "strings": 5, "symbols": 6, "string_bytes": 10, "symbol_bytes": 11}
"""Entries of the dynamic section (DT_HASH, DT_STRTAB, DT_SYMTAB, DT_STRSZ, DT_SYMENT)."""


class Machine(IntEnum):
    """Processors, as the header of a file numbers them."""

    X86_64 = 62
    AARCH64 = 183


class Kind(IntEnum):
    """Kinds of sections."""

    SYMBOL_TABLE = 2
    RELOCATIONS = 4
    NO_BITS = 8


class Flag(IntFlag):
    """Flags of a section: whether a process has it in memory, and may write to it."""

    WRITABLE = 1
    ALLOCATED = 2


class Section(NamedTuple):
    """Header of a section of an object file."""

    name: int
    kind: int
    flags: int
    address: int
    offset: int
    size: int
    link: int
    info: int
    alignment: int
    entry: int


def shared_library(code: bytes, names: Sequence[str]) -> bytes:
    """Make a shared library of an object file.

    code: the object file: ELF-64 for x86-64 or AArch64; names: functions that are found by their
    names. ValueError: the object file needs what this linker does not do; the text says what.
    """
    head = struct.unpack_from(HEADER, code)
    machine, table, size, count = head[2], head[6], head[11], head[12]
    if not code.startswith(b"\x7fELF\x02\x01") or machine not in list(Machine):
        raise ValueError("no object file of ELF-64 for x86-64 or AArch64")
    sections = [Section(*struct.unpack_from(SECTION, code, table + i * size)) for i in range(count)]
    symbols, strings = _symbols(code, sections)
    places, end = {}, PAGE
    for index, item in enumerate(sections):
        if (
            item.flags & Flag.ALLOCATED
            and item.size
            and not _is_frame(code, sections, head[13], item)
        ):
            if item.flags & Flag.WRITABLE or item.kind == Kind.NO_BITS:
                raise ValueError("data that change")
            end = -(-end // max(item.alignment, 16)) * max(item.alignment, 16)
            places[index] = end
            end += item.size
    image = bytearray(end)
    for index, place in places.items():
        item = sections[index]
        image[place : place + item.size] = code[item.offset : item.offset + item.size]
    found = {}
    for name, _, _, section, value, _ in symbols:
        if section in places:
            found[_text(strings, name)] = places[section] + value
    for item in sections:
        if item.kind == Kind.RELOCATIONS and item.info in places:
            for at in range(item.offset, item.offset + item.size, 24):
                where, info, addend = struct.unpack_from("<QQq", code, at)
                name, _, _, section, value, _ = symbols[info >> 32]
                if section not in places:
                    raise ValueError(f"a call of {_text(strings, name)}, which is not in the file")
                place = places[item.info] + where
                target = places[section] + value + addend
                _relocate(image, machine, info & 0xFFFFFFFF, place, target)
    return _linked(image, machine, {name: found[name] for name in names})


def _symbols(
    code: bytes, sections: Sequence[Section]
) -> tuple[list[tuple[int, int, int, int, int, int]], bytes]:
    table = next(item for item in sections if item.kind == Kind.SYMBOL_TABLE)
    names = sections[table.link]
    found = struct.iter_unpack(SYMBOL, code[table.offset : table.offset + table.size])
    return [*found], code[names.offset : names.offset + names.size]


def _is_frame(code: bytes, sections: Sequence[Section], index: int, item: Section) -> bool:
    """Whether a section tells how to unwind the stack: nothing here throws."""
    names = sections[index]
    name = _text(code[names.offset : names.offset + names.size], item.name)
    return name == ".eh_frame" or name.startswith(".note")


def _text(strings: bytes, place: int) -> str:
    return strings[place : strings.index(b"\0", place)].decode()


def _relocate(image: bytearray, machine: int, kind: int, place: int, target: int) -> None:
    """Write a reference as the ABI's supplement for the processor has it."""
    if machine == Machine.X86_64:
        if kind not in (2, 4):  # R_X86_64_PC32, R_X86_64_PLT32
            raise ValueError(f"relocation {kind} of x86-64")
        struct.pack_into("<i", image, place, target - place)
        return
    (word,) = struct.unpack_from("<I", image, place)
    if kind == 261:  # R_AARCH64_PREL32
        struct.pack_into("<i", image, place, target - place)
        return
    if kind in (282, 283):  # R_AARCH64_JUMP26, CALL26
        word |= (target - place) >> 2 & 0x3FFFFFF
    elif kind == 275:  # R_AARCH64_ADR_PREL_PG_HI21
        pages = (target >> 12) - (place >> 12)
        word |= (pages & 3) << 29 | (pages >> 2 & 0x7FFFF) << 5
    elif kind in LOW_12_BITS:
        word |= (target & 0xFFF) >> LOW_12_BITS[kind] << 10
    else:
        raise ValueError(f"relocation {kind} of AArch64")
    struct.pack_into("<I", image, place, word)


LOW_12_BITS = {277: 0, 278: 0, 284: 1, 285: 2, 286: 3, 299: 4}
"""R_AARCH64_ADD_ABS_LO12_NC and LDST8, 16, 32, 64, 128, with the shift of their operand."""


def _linked(image: bytearray, machine: int, exported: dict[str, int]) -> bytes:
    """Put headers and tables before the code, and the dynamic section behind it."""
    strings = b"\0" + b"".join(name.encode() + b"\0" for name in exported)
    table, place = bytearray(24), 1
    for name, value in exported.items():
        table += struct.pack(SYMBOL, place, 0x12, 0, 1, value, 0)  # a global function
        place += len(name) + 1
    chain = [*range(2, len(exported) + 1), 0] if exported else []
    hashes = struct.pack(f"<{4 + len(chain)}I", 1, len(chain) + 1, 1 if exported else 0, 0, *chain)
    parts, at = {}, 64 + 4 * 56
    for name, part in (("hash", hashes), ("symbols", bytes(table)), ("strings", strings)):
        at = -(-at // 8) * 8
        image[at : at + len(part)] = part
        parts[name] = at
        at += len(part)
    if at > PAGE:
        raise ValueError("too many names")
    parts |= {"string_bytes": len(strings), "symbol_bytes": 24}
    dynamic = b"".join(struct.pack("<QQ", tag, parts[key]) for key, tag in FIXED_TAGS.items())
    dynamic += bytes(16)
    start = -(-len(image) // PAGE) * PAGE
    programs = [
        (1, 5, 0, 0, 0, len(image), len(image), PAGE),  # code and constants
        (1, 6, start, start, start, len(dynamic), len(dynamic), PAGE),
        (2, 6, start, start, start, len(dynamic), len(dynamic), 8),
        (0x6474E551, 6, 0, 0, 0, 0, 0, 16),  # the stack holds no code
    ]
    identity = b"\x7fELF\x02\x01\x01".ljust(16, b"\0")
    struct.pack_into(
        HEADER, image, 0, identity, 3, machine, 1, 0, 64, 0, 0, 64, 56, len(programs), 64, 0, 0
    )
    for index, item in enumerate(programs):
        struct.pack_into(PROGRAM, image, 64 + 56 * index, *item)
    return bytes(image).ljust(start, b"\0") + dynamic
