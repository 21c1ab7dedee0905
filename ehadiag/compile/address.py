"""Direct calls of compiled code by address, without numba's dispatcher (for the monitor's push).

Its dispatcher looks at the type of every argument, and an array that is handed over becomes an
object of numba's own while the call lasts. Back to back that is a quarter of a microsecond. A
thread that wakes once a millisecond finds none of it in the caches: there it is half of the call.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

__all__ = ["array_at", "entry_point"]


def entry_point(kernel: Callable[..., Any], *arguments: types.Type) -> Callable[..., Any]:
    """Compile a kernel for arguments of these types; return its code, to be called at once.

    What it is called with is converted to these types; an array is not looked at and must fit.
    """
    if not hasattr(kernel, "compile"):  # absent with NUMBA_DISABLE_JIT=1
        return kernel
    code: Callable[..., Any] = kernel.compile(arguments)
    return code


def array_at(address: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the numbers in memory from `address` on, rows first. Their owner keeps them alive."""
    pointer = ctypes.cast(address, ctypes.POINTER(ctypes.c_double))
    view: NDArray[np.float64] = numba.carray(pointer, shape)
    return view


@intrinsic
def _pointer(_typing: Any, _address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float64)(types.intp), generate


@overload(array_at)
def _compiled_array_at(address: Any, shape: Any) -> Any:  # noqa: ARG001 - numba looks at the names
    def compiled(address: Any, shape: Any) -> Any:  # annotated alike, numba compares
        return numba.carray(_pointer(address), shape)

    return compiled
