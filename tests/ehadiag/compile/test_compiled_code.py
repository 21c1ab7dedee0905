"""Kernels are called with what their annotations name.

Arithmetic of single precision out of that of doubles: against numpy's, number by number.
"""

from __future__ import annotations

import ctypes
import struct
from typing import NamedTuple

import llvmlite.binding as llvm
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ehadiag.compile.jit import Array2, brief_kernel, kernel
from ehadiag.compile.object_code import single_precision
from ehadiag.compile.vector import array_at
from ehadiag.compile.worker import CFunction, ObjectFile, PointerArgument, Processor, object_code


@brief_kernel
def last_set(address: int, value: float) -> float:
    """Set the last of six numbers from the second on; return what was there."""
    block = array_at(address + 8, (2, 3))
    before = block[1, 2]
    block[1, 2] = value
    return before


class Pair(NamedTuple):
    """A tuple with an array in it."""

    scale: float
    table: Array2


@kernel
def weighted(pair: Pair, index: NDArray[np.int64], negative: bool) -> float:
    """Sum of some rows of a table."""
    total = 0.0
    for k in range(index.shape[0]):
        for i in range(pair.table.shape[1]):
            total += pair.scale * pair.table[index[k], i]
    return -total if negative else total


TABLE = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


@brief_kernel
def replace_by_table(address: int) -> int:
    """Write the number of a constant array that a place in it names."""
    number = array_at(address, (1,))
    place = int(number[0])
    number[0] = TABLE[place // 3, place % 3]
    return place


@pytest.mark.parametrize("compiled", [False, True])
def test_an_array_at_an_address_is_that_memory(compiled):
    memory = np.arange(8.0)
    code = last_set if compiled else last_set.py_func
    assert code(memory.ctypes.data, 40.0) == 6.0
    np.testing.assert_array_equal(memory, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 40.0, 7.0])


@pytest.mark.parametrize(
    ("triple", "order"),
    [("", "="), ("aarch64-unknown-linux-gnu", "<"), ("powerpc-unknown-linux-gnu", ">")],
)
def test_a_constant_array_has_the_byte_order_of_the_target(triple, order):
    function = CFunction("f", replace_by_table, (PointerArgument(),))
    (code,) = object_code(ObjectFile((function,), Processor(triple)))
    assert struct.pack(f"{order}6d", *TABLE.ravel()) in code


def test_a_number_of_a_constant_array_is_that_of_its_place():
    number = np.array([5.0])
    assert replace_by_table(number.ctypes.data) == 5
    assert number[0] == 0.6


def test_arguments_reach_a_kernel_as_they_are_annotated():
    given = Pair(2.0, np.arange(6.0).reshape(3, 2)), np.array([0, 2])
    for negative in (False, True):
        assert weighted(*given, negative) == weighted.py_func(*given, negative)
    turned = Pair(2.0, given[0].table.T.copy().T)  # not contiguous
    assert weighted(turned, given[1], False) == weighted(*given, False)
    for wrong in (np.arange(6.0), np.arange(6).reshape(3, 2)):
        with pytest.raises(TypeError, match="dimensions: need"):
            weighted(Pair(2.0, wrong), given[1], False)


DOUBLE = """
define double @f(double %x, double %y) {
  %1 = fadd double %x, 1.000000e-01
  %named.i = fmul double %1, %y
  %"q u" = fdiv double %named.i, 0x3FB999999999999A
  %2 = call double @llvm.sqrt.f64(double %"q u")
  %3 = fptosi double %2 to i64
  %4 = sitofp i64 %3 to double
  %5 = fsub double %2, %4
  ret double %5
}
declare double @llvm.sqrt.f64(double)
"""


@pytest.fixture(scope="module")
def compiled():
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(single_precision(DOUBLE)), machine)
    engine.finalize_object()
    kind = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double, ctypes.c_double)
    return engine, kind(engine.get_function_address("f"))


@given(st.floats(2**-20, 2**20, width=32), st.floats(2**-20, 2**20, width=32))
def test_it_is_the_arithmetic_of_numpys_single_precision(compiled, x, y):
    share = (np.float32(x) + np.float32(0.1)) * np.float32(y) / np.float32(0.1)
    root = np.sqrt(share)
    assert compiled[1](x, y) == float(root - np.float32(int(root)))


def test_each_result_and_constant_is_rounded():
    text = single_precision(DOUBLE)
    module = llvm.parse_assembly(text)
    module.verify()
    assert text.count("fptrunc double") == 6
    assert "0x3FB99999A0000000" in text
    assert "@llvm.sqrt.f32(float" in text
    assert "call double @llvm.sqrt" not in text


@pytest.mark.parametrize(
    "line", ["  %1 = load double, ptr %p", "  %1 = fcmp olt double %x, 1.0e-01"]
)
def test_what_is_no_arithmetic_stays(line):
    assert single_precision(line) == line
