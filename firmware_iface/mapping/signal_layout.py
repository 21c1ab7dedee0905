"""Locates a signal in a payload and extracts it from many frames at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["SignalLayout"]

WORD_BITS = 64
PIECE_BITS = 32


@dataclass(frozen=True, slots=True)
class SignalLayout:
    """Place and number format of one signal.

    Attributes
    ----------
    name : str
        As in the DBC.
    start : int
        DBC start bit: the least significant bit of a little-endian signal, the most significant
        one of a big-endian signal, both counted 8 * byte + bit.
    length : int
        Bits, 1 … 64.
    big_endian : bool
        Number format; floats have 16, 32 or 64 bits.
    signed : bool
        See `big_endian`.
    is_float : bool
        See `big_endian`.
    scale : float
        Physical value = raw * scale + offset.
    offset : float
        See `scale`.
    minimum : float | None
        Physical range, None where the DBC gives none.
    maximum : float | None
        See `minimum`.
    unit : str
        Unit text of the DBC.
    selectors : tuple[tuple[SignalLayout, frozenset[int]], ...]
        Multiplexers that must all hold one of their values for the signal to be present.
    """

    name: str
    start: int
    length: int
    big_endian: bool = False
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    selectors: tuple[tuple[SignalLayout, frozenset[int]], ...] = ()

    @property
    def lead(self) -> int:
        """Bits before the signal: from bit 0 of byte 0, or from the payload's first (top) bit."""
        if self.big_endian:
            return 8 * (self.start // 8) + 7 - self.start % 8
        return self.start

    @property
    def last_byte(self) -> int:
        """Index of the last payload byte that the signal touches."""
        return (self.lead + self.length - 1) // 8

    def bits(self, data: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """Bit pattern of the signal in each payload; data of shape (n, width), result (n,)."""
        return _bits(data, self.lead, self.length, self.big_endian)

    def raw(self, data: NDArray[np.uint8]) -> NDArray[np.int64] | NDArray[np.float64]:
        """Raw number of each payload, before scale and offset.

        Unsigned 64-bit values above the signed range wrap: no role of ours is that wide.
        """
        pattern = self.bits(data)
        if self.is_float:
            return _as_float(pattern, self.length)
        if not self.signed:
            return pattern.astype(np.int64)
        spare = np.uint64(WORD_BITS - self.length)
        shifted: NDArray[np.int64] = (pattern << spare).view(np.int64)
        return shifted >> spare.astype(np.int64)

    def physical(self, data: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Physical value in the DBC's unit, shape (n,)."""
        raw = self.raw(data).astype(np.float64)
        if self.scale != 1.0:
            raw *= self.scale
        if self.offset != 0.0:
            raw += self.offset
        return raw

    def present(self, data: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        """Which payloads carry the signal; None if all do."""
        if not self.selectors:
            return None
        mask = np.ones(len(data), dtype=np.bool_)
        for selector, values in self.selectors:
            mask &= np.isin(selector.raw(data), sorted(values))
        return mask


def _bits(data: NDArray[np.uint8], lead: int, length: int, big: bool) -> NDArray[np.uint64]:
    width = data.shape[1]
    first, last = lead // 8, (lead + length - 1) // 8
    if last - first >= 8 or width < 8:
        return _bits_in_pieces(data, lead, length, big)
    base = min(first, width - 8)
    if width == 8 and data.flags.c_contiguous:
        word = data.view(">u8" if big else "<u8").reshape(-1)
    else:
        window = np.ascontiguousarray(data[:, base : base + 8])
        word = window.view(">u8" if big else "<u8").reshape(-1)
    inside = lead - 8 * base
    shift = WORD_BITS - inside - length if big else inside
    out: NDArray[np.uint64] = word.astype(np.uint64, copy=False) >> np.uint64(shift)
    if length < WORD_BITS:
        out &= np.uint64((1 << length) - 1)
    return out


def _bits_in_pieces(
    data: NDArray[np.uint8], lead: int, length: int, big: bool
) -> NDArray[np.uint64]:
    """Signals over nine bytes, and payload tables narrower than a word."""
    if data.shape[1] < 8:
        wide = np.zeros((len(data), 8), dtype=np.uint8)
        wide[:, : data.shape[1]] = data
        return _bits(wide, lead, length, big)
    rest = length - PIECE_BITS
    head = _bits(data, lead, PIECE_BITS, big)
    tail = _bits(data, lead + PIECE_BITS, rest, big)
    if big:
        return (head << np.uint64(rest)) | tail
    return head | (tail << np.uint64(PIECE_BITS))


def _as_float(pattern: NDArray[np.uint64], length: int) -> NDArray[np.float64]:
    if length == 64:
        return pattern.view(np.float64)
    if length == 32:
        single = pattern.astype(np.uint32).view(np.float32)
    else:
        single = pattern.astype(np.uint16).view(np.float16)
    with np.errstate(invalid="ignore"):  # signalling NaN patterns are legal payloads
        return single.astype(np.float64)
