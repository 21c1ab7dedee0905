"""Data types of kernels: SIMD vectors, arrays at an address, named tuples in flat arrays.

A vector is a numba type that holds a number for each of VECTOR_WIDTH candidates; arithmetic on it
is vector instructions (`ehadiag.compile.vector_types`). How many candidates a kernel takes is fixed
when it is compiled: the same source makes kernels of blocks and of a single candidate. Without the
compiler there is one candidate, and all of it works on numpy's arrays.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from itertools import accumulate
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile import worker
from ehadiag.compile.jit import Array, Kernel, inlined, is_plain

BYTES_PER_NUMBER = 8
"""Size of a number in memory, bytes."""
LANES = 1 if is_plain() else worker.process_lanes
"""Candidates of a block, 1."""
VECTOR_WIDTH = min(LANES, 8)
"""Numbers of a vector, 1."""
Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

VECTOR_MATH_FLAGS = ("contract", "nnan", "nsz")
"""Products and sums may fuse; no NaN enters the model."""

F = TypeVar("F", bound=Callable[..., Any])


def packed(function: F) -> F:
    """Compile as a part of the kernels that call it, for vectors or for numbers.

    Nothing is allocated in it, so that no references to arrays need be counted.
    """
    options = {"error_model": "numpy", "forceinline": True, "fastmath": set(VECTOR_MATH_FLAGS)}
    return cast("F", Kernel(function, False, _nrt=False, **options))


def large_packed(function: F) -> F:
    """Compile like `packed`, but as a function of its own, without a copy in each kernel."""
    options = {"error_model": "numpy", "forceinline": False, "fastmath": set(VECTOR_MATH_FLAGS)}
    return cast("F", Kernel(function, False, _nrt=False, **options))


def load(array: Array, start: int) -> Vector:
    """VECTOR_WIDTH numbers of a flat array from `start`."""
    return array[start : start + VECTOR_WIDTH].copy()


def store(array: Array, start: int, value: Any) -> None:
    """Write VECTOR_WIDTH numbers to a flat array from `start`."""
    array[start : start + VECTOR_WIDTH] = value


def where(mask: Mask, yes: Any, no: Any) -> Vector:
    """Choose lane by lane."""
    return np.where(mask, yes, no)


def minimum(a: Any, b: Any) -> Vector:
    """Lesser of two, lane by lane."""
    return np.minimum(a, b)


def maximum(a: Any, b: Any) -> Vector:
    """Greater of two, lane by lane."""
    return np.maximum(a, b)


def absolute(a: Any) -> Vector:
    """Absolute value, lane by lane."""
    return np.abs(a)


def lane_sqrt(a: Any) -> Vector:
    """Square root, lane by lane."""
    return np.sqrt(a)


def copy_sign(size: Any, sign: Any) -> Vector:
    """Numbers of one vector with the signs of another, lane by lane."""
    return np.copysign(size, sign)


def any_lane(mask: Mask) -> bool:
    """Whether the mask is true in any lane."""
    return bool(np.any(mask))


def first_lane(mask: Mask) -> int:
    """First lane in which the mask is true, VECTOR_WIDTH if it is in none."""
    return int(np.argmax(mask)) if np.any(mask) else VECTOR_WIDTH


def shifted_lanes(first: float, vector: Vector) -> Vector:
    """Put every number one lane further on, `first` into the first lane; the last is lost."""
    return np.concatenate([[first], vector[:-1]])


def last_lane(vector: Vector) -> float:
    """Number in the last lane."""
    return float(vector[-1])


@packed
def store_where(array: Array, start: int, mask: Mask, value: Any) -> None:
    """Write those of VECTOR_WIDTH numbers that a mask chooses to a flat array from `start`."""
    store(array, start, where(mask, value, load(array, start)))


def array_at(address: int, shape: tuple[int, ...]) -> Array:
    """Return the numbers in memory from `address` on, rows first. Their owner keeps them alive."""
    count = int(np.prod(shape))
    memory: Any = (ctypes.c_double * count).from_address(address)
    return np.frombuffer(memory, dtype=np.float64).reshape(shape)


def places(*parts: Any) -> tuple[int, ...]:
    """Places of parts one behind the other, and the end of the last.

    A part is a number of numbers, or a named tuple with one for each field.
    """
    lengths = (part if isinstance(part, int) else len(part._fields) for part in parts)
    return tuple(accumulate(lengths, initial=0))


def unpacker(kind: Any, start: int = 0) -> Any:
    """Compiled function of an array that makes a named tuple of the numbers from a place on."""
    numbers = ", ".join(f"row[{start + index}]" for index in range(len(kind._fields)))
    return _compiled(f"def unpack(row):\n    return kind({numbers})", "unpack", kind)


def packer(kind: Any, start: int = 0) -> Any:
    """Compiled function of an array and a named tuple that writes its numbers from `start`."""
    lines = "".join(
        f"\n    row[{start + index}] = value.{name}" for index, name in enumerate(kind._fields)
    )
    return _compiled(f"def pack(row, value):{lines}", "pack", kind)


def lane_of(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array and a lane that makes a named tuple of that lane's numbers.

    The array holds rows of `lanes` numbers; the fields stand in the rows from `first`.
    """
    numbers = ", ".join(
        f"row[{(first + index) * lanes} + lane]" for index in range(len(kind._fields))
    )
    return _compiled(f"def unpack(row, lane):\n    return kind({numbers})", "unpack", kind)


def lane_packer(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array, a lane and a named tuple that writes the lane's numbers."""
    lines = "".join(
        f"\n    row[{(first + index) * lanes} + lane] = value.{name}"
        for index, name in enumerate(kind._fields)
    )
    return _compiled(f"def pack(row, lane, value):{lines}", "pack", kind)


def lanes_of(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array and a lane: a named tuple of vectors from that lane on."""
    numbers = ", ".join(
        f"load(row, {(first + index) * lanes} + lane)" for index in range(len(kind._fields))
    )
    scope: dict[str, Any] = {"kind": kind, "load": load}
    exec(f"def unpack(row, lane):\n    return kind({numbers})", scope)
    return packed(scope["unpack"])


def lanes_packer(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array, a lane and a named tuple of vectors: written from there on."""
    lines = "".join(
        f"\n    store(row, {(first + index) * lanes} + lane, value.{name})"
        for index, name in enumerate(kind._fields)
    )
    scope: dict[str, Any] = {"store": store}
    exec(f"def pack(row, lane, value):{lines}", scope)
    return packed(scope["pack"])


def _compiled(source: str, name: str, kind: Any) -> Any:
    scope: dict[str, Any] = {"kind": kind}
    exec(source, scope)
    return inlined(scope[name])
