"""Decorators of the functions that are compiled, and how Python calls them.

A kernel that Python calls is a C function of a library, `int name(slots)`. Its arguments stand one
behind the other in memory, as the annotations name them: numbers, arrays (one dimension unless
annotated `Array2` or `Array3`), named tuples of these. Other decorated functions are parts of
kernels; Python runs them as they are written. numba is loaded only by the process that compiles.
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from importlib import import_module
from typing import Annotated, Any, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers in double precision, as kernels take them."""
Array2 = Annotated[Array, 2]
Array3 = Annotated[Array, 3]
"""The same with two and three dimensions."""

F = TypeVar("F", bound=Callable[..., Any])


class ArrayKind(NamedTuple):
    """Array that a kernel takes: contiguous, rows first."""

    dtype: np.dtype[Any]
    ndim: int


Kind = Any
"""Kind of an argument: the letter of a number in `struct` (d, q, ?), an `ArrayKind`, or for a tuple
its type and the kinds of its parts."""
NUMBERS = {float: "d", Any: "d", int: "q", bool: "?"}
"""Letters of numbers; a law's `Any` is a number or a vector, and here a number."""


@cache
def kind_of(annotation: Any) -> Kind:
    """Kind of an argument with this annotation."""
    if annotation in NUMBERS:
        return NUMBERS[annotation]
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return kind_of(arguments[0])._replace(ndim=arguments[1])
    if origin is np.ndarray:
        return ArrayKind(np.dtype(get_args(arguments[1])[0]), 1)
    if origin is tuple:
        return tuple, [kind_of(item) for item in arguments]
    hints = get_type_hints(annotation, include_extras=True)
    return annotation, [kind_of(hints[name]) for name in annotation._fields]


class Kernel:
    """A function that is compiled: by itself (`is_entry`) or as a part of others.

    options: of numba's compiler.
    """

    def __init__(self, function: Callable[..., Any], is_entry: bool, **options: Any) -> None:
        update_wrapper(self, function)
        # numba looks at both names.
        self.py_func = function
        self.targetoptions = options
        self.is_entry = is_entry

    def __call__(self, *arguments: Any) -> Any:
        """Run the compiled kernel; the function as it is written where it is only a part."""
        return self._called(*arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies to another process are the object of the same name there."""
        return _named, (self.py_func.__module__, self.py_func.__qualname__)

    @property
    def _numba_type_(self) -> Any:
        """What numba takes this object for; only where something is compiled."""
        from ehadiag.compile.frontend import dispatcher_type  # noqa: PLC0415 - loads numba

        return dispatcher_type(self)

    @cached_property
    def kinds(self) -> tuple[list[Kind], Kind]:
        """Kinds of arguments and result."""
        hints = get_type_hints(self.py_func, include_extras=True)
        result = hints.pop("return")
        return [kind_of(item) for item in hints.values()], NUMBERS.get(result)

    @cached_property
    def _called(self) -> Callable[..., Any]:
        if not self.is_entry:
            return self.py_func
        if is_plain():
            return lambda *arguments: self.py_func(*map(_unpacked, arguments))
        code, layout, read = self._compiled
        kinds = self.kinds[0]

        def call(*arguments: Any) -> Any:
            slots: list[Any] = []
            copies: list[tuple[Array, Array]] = []
            _fill(slots, kinds, arguments, copies)
            block = bytearray(layout.pack(*slots))
            if code(ctypes.addressof(ctypes.c_char.from_buffer(block))) != 0:
                raise RuntimeError(f"{self.py_func.__qualname__}: the kernel has failed")
            for given, copy in copies:
                if given.flags.writeable:
                    given[...] = copy
            return read.unpack_from(block)[0] if read else None

        return call

    def of_one_thread(self) -> Callable[..., Any]:
        """Return a function for calls of a microsecond: the address of memory, then numbers alone.

        Its arguments stand at one place in each call, so that it is for one thread at a time.
        """
        if is_plain():
            return lambda address, *numbers: self.py_func(address, numbers)
        code, layout, read = self._compiled
        block = ctypes.create_string_buffer(layout.size)
        place, pack = ctypes.addressof(block), layout.pack_into

        def call(*numbers: Any) -> Any:
            pack(block, 0, *numbers)
            code(place)
            return read.unpack_from(block)[0] if read else None

        return call

    @cached_property
    def _compiled(self) -> tuple[Callable[[int], int], struct.Struct, struct.Struct | None]:
        """Compiled code, and the layouts of its arguments and its result."""
        from ehadiag.compile.libraries import entry_address  # noqa: PLC0415 - only who calls

        kinds, result = self.kinds
        kind = ctypes.CFUNCTYPE if self.targetoptions.get("nogil") else ctypes.PYFUNCTYPE
        code = kind(ctypes.c_int, ctypes.c_void_p)(entry_address(self))
        layout = struct.Struct("=8x" + "".join(_letters(kinds)))
        return code, layout, struct.Struct(f"={result}") if result else None


def is_plain() -> bool:
    """Whether kernels run as they are written, by numba's setting for that."""
    return os.environ.get("NUMBA_DISABLE_JIT") == "1"


def _named(module: str, name: str) -> Any:
    return getattr(import_module(module), name)


def _letters(kinds: list[Kind]) -> list[str]:
    """Letters of the slots in `struct`, each of 8 bytes."""
    found: list[str] = []
    for kind in kinds:
        if isinstance(kind, ArrayKind):
            found += "q" * (5 + 2 * kind.ndim)
        elif isinstance(kind, tuple):
            found += _letters(kind[1])
        else:
            found += ["?7x"] if kind == "?" else [kind]
    return found


def _fill(
    slots: list[Any], kinds: list[Kind], values: Any, copies: list[tuple[Array, Array]]
) -> None:
    """Append the slots of values: of an array those that numba's functions take.

    copies: gets arrays that are not contiguous, with the copies that the kernel works on.
    """
    for kind, value in zip(kinds, values, strict=True):
        if isinstance(kind, ArrayKind):
            if value.dtype != kind.dtype or value.ndim != kind.ndim:
                raise TypeError(f"{value.dtype} of {value.ndim} dimensions: need {kind}")
            if not value.flags.c_contiguous:
                copies.append((value, np.ascontiguousarray(value)))
                value = copies[-1][1]  # noqa: PLW2901 - what the kernel is given
            slots += (0, 0, value.size, value.itemsize, _address(value))
            slots += value.shape
            slots += value.strides
        elif isinstance(kind, tuple):
            if isinstance(value, Packed):
                slots += value.slots
            else:
                _fill(slots, kind[1], value, copies)
        else:
            slots.append(value)


def _address(value: Array) -> int:
    """Where the numbers of a contiguous array stand: in most a third of the time of numpy's."""
    if value.size and value.flags.writeable:
        return ctypes.addressof(ctypes.c_char.from_buffer(value.data))
    return int(value.ctypes.data)


class Packed(NamedTuple):
    """A named tuple of contiguous arrays with its slots, for an argument of many calls."""

    value: Any
    """Keeps the arrays."""
    slots: tuple[Any, ...]


def _unpacked(argument: Any) -> Any:
    """Argument of a kernel that runs as it is written."""
    return argument.value if isinstance(argument, Packed) else argument


T = TypeVar("T", bound=tuple[Any, ...])


def packed_argument(value: T) -> T:
    """Work out the slots of a named tuple, to be given to kernels in its place in many calls.

    TypeError where an array is not contiguous.
    """
    slots: list[Any] = []
    copies: list[tuple[Array, Array]] = []
    _fill(slots, kind_of(type(value))[1], value, copies)
    if copies:
        raise TypeError(f"{type(value).__name__}: need contiguous arrays")
    return cast("T", Packed(value, tuple(slots)))


def kernel(function: F) -> F:
    """Compile what Python calls: without the interpreter's lock, IEEE division, no allocation."""
    return cast("F", Kernel(function, True, nogil=True, error_model="numpy", _nrt=False))


def brief_kernel(function: F) -> F:
    """Compile like `kernel`, for calls of a microsecond: the interpreter lock is kept.

    To give it back and take it again costs more than such a call, and with another thread that runs
    Python it may take milliseconds.
    """
    return cast("F", Kernel(function, True, error_model="numpy", _nrt=False))


def bare_kernel(function: F) -> F:
    """Compile as a function of its own that kernels call, without a copy in each."""
    # Else numba lets it take over from its caller that it is to be inlined.
    return _part(function, forceinline=False)


def inlined(function: F) -> F:
    """Compile as a part of the kernels that call it: named tuples cost nothing to hand over.

    A product and a sum may become one instruction with one rounding, nothing else is loosened.
    """
    return _part(function, forceinline=True, fastmath={"contract"})


def inlined_exact(function: F) -> F:
    """Compile like `inlined`, with each product and each sum rounded by itself."""
    return _part(function, forceinline=True)


def merged(function: F) -> F:
    """Make it a part of the one kernel that calls it, with that one's options.

    Unlike `inlined` it is not compiled by itself before, and what it calls with it.
    """
    return _part(function, inline="always")


def _part(function: F, **options: Any) -> F:
    return cast("F", Kernel(function, False, error_model="numpy", _nrt=False, **options))
