"""Arithmetic of single precision out of that of doubles: against numpy's, number by number."""

import ctypes

import llvmlite.binding as llvm
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.compile.single import single_precision

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
