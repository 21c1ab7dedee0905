"""Direct calls of compiled code by address give what normal calls give."""

import numba
import numpy as np
import pytest
from numba import types

from ehadiag.compile.address import array_at, entry_point


def last_set(address, value):
    """Without a compiler this is what runs."""
    block = array_at(address + 8, (2, 3))
    before = block[1, 2]
    block[1, 2] = value
    return before


@pytest.mark.parametrize("compiled", [False, True])
def test_an_array_at_an_address_is_that_memory(compiled):
    memory = np.arange(8.0)
    code = last_set
    if compiled:
        code = entry_point(numba.njit(last_set), types.intp, types.float64)
    assert code(memory.ctypes.data, 40) == 6.0
    np.testing.assert_array_equal(memory, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 40.0, 7.0])


def test_code_is_compiled_once():
    kernel = numba.njit(last_set)
    code = entry_point(kernel, types.intp, types.float64)
    assert entry_point(kernel, types.intp, types.float64) is code
    # With NUMBA_DISABLE_JIT=1 a kernel is the function itself.
    assert entry_point(last_set, types.intp, types.float64) is last_set
