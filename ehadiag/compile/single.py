"""Arithmetic of single precision in code that was written for doubles, on LLVM's text.

Numbers keep their eight bytes in memory; each result of arithmetic is rounded to single precision,
and so is each constant in it. For sum, difference, product, quotient and root that is what an
instruction of single precision gives (Figueroa, When is double rounding innocuous?, SIGNUM 30(3),
1995), so a compiler takes that where a processor has no other.
"""

from __future__ import annotations

import re
import struct

__all__ = ["single_precision"]

NAME = r'%(?:"[^"]+"|[\w.$-]+)'
KIND = r"double|<\d+ x double>"
ARITHMETIC = re.compile(
    rf"^  ({NAME}) = ((?:fadd|fsub|fmul|fdiv) ({KIND}) |(?:sitofp|uitofp) .* to ({KIND}))(.*)$",
    re.M,
)
ROOT = re.compile(
    rf"^  ({NAME}) = (?:tail )?call double @llvm\.sqrt\.f64\(double ([^)]+)\).*$", re.M
)
CONSTANT = re.compile(r"(?<![\w.%\"-])(-?\d+\.\d+e[+-]\d+|0x[0-9A-F]{16})\b")


def single_precision(text: str) -> str:
    """Round results of arithmetic on doubles to single precision.

    Parameters
    ----------
    text : str
        Of a module, as LLVM prints it.

    Returns
    -------
    str
        The same, each result rounded.
    """
    text = ROOT.sub(_root, ARITHMETIC.sub(_rounded, text))
    if "@llvm.sqrt.f32(" in text:
        text += "\ndeclare float @llvm.sqrt.f32(float)\n"
    return text


def _inner(name: str, what: str) -> str:
    plain = name[1:].strip('"')
    return f'%"{plain}.{what}"'


def _rounded(found: re.Match[str]) -> str:
    name, operation, kind, made, rest = found.groups()
    kind = kind or made
    narrow = kind.replace("double", "float")
    wide, cut = _inner(name, "wide"), _inner(name, "single")
    return (
        f"  {wide} = {operation}{CONSTANT.sub(_constant, rest)}\n"
        f"  {cut} = fptrunc {kind} {wide} to {narrow}\n"
        f"  {name} = fpext {narrow} {cut} to {kind}"
    )


def _root(found: re.Match[str]) -> str:
    name, of = found.groups()
    cut, root = _inner(name, "of"), _inner(name, "single")
    return (
        f"  {cut} = fptrunc double {of} to float\n"
        f"  {root} = call float @llvm.sqrt.f32(float {cut})\n"
        f"  {name} = fpext float {root} to double"
    )


def _constant(found: re.Match[str]) -> str:
    said = found[0]
    number = (
        struct.unpack(">d", bytes.fromhex(said[2:]))[0] if said.startswith("0x") else float(said)
    )
    try:
        rounded = struct.unpack(">f", struct.pack(">f", number))[0]
    except OverflowError:  # no number of single precision
        return said
    return f"0x{struct.pack('>d', rounded).hex().upper()}"
