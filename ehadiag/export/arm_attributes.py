"""Marks an Arm object file as fit for either calling convention of floating-point numbers.

A linker joins only objects of one convention, and numba's compiler emits one alone. The exported
functions take pointers and return a whole number, which both conventions hand over alike, and the
attribute that says so (Tag_ABI_VFP_args = 3, Addenda to the ABI for the Arm Architecture, 2.3.6)
has no other way into the file.
"""

from __future__ import annotations

import struct

__all__ = ["either_convention"]

ELF_32_LITTLE = b"\x7fELF\x01\x01"
ATTRIBUTES = 0x70000003
"""Type of the section."""
HALF_FLOAT_FORMAT = b"\x26\x01"
"""Tag_ABI_FP_16bit_format = IEEE: no such numbers are in the code, so that its place is free."""
EITHER = b"\x1c\x03"


def either_convention(code: bytes) -> bytes:
    """Mark an object file; one that is not of a 32-bit Arm is returned as it is.

    Parameters
    ----------
    code : bytes
        The object file.

    Returns
    -------
    bytes
        The object file, of the same length.

    Raises
    ------
    ValueError
        It has no place for the mark.
    """
    if not code.startswith(ELF_32_LITTLE):
        return code
    (table,) = struct.unpack_from("<I", code, 32)
    size, count = struct.unpack_from("<HH", code, 46)
    for index in range(count):
        _, kind, _, _, start, length = struct.unpack_from("<6I", code, table + index * size)
        if kind == ATTRIBUTES:
            place = code.rindex(HALF_FLOAT_FORMAT, start, start + length)
            return code[:place] + EITHER + code[place + len(EITHER) :]
    return code
