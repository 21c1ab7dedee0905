"""Kernels that fuse nothing have the same bits for blocks of either width."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
from effect_cases import batch_of, unknowns_of
from msgspec.structs import replace

from ehadiag import default_actuator
from ehadiag.compile import libraries
from ehadiag.compile.elementary import C_FUNCTIONS, ROUNDING_FUNCTIONS
from ehadiag.compile.jit import Kernel
from ehadiag.compile.worker import CFunction, ObjectFile, SlotArguments, object_code
from ehadiag.export.targets import c_compiler, link_shared
from ehadiag.model.batch import SIGNAL_ROWS, Anchor
from ehadiag.model.residual_models import SimdModel
from ehadiag.model.simd_residuals import block_scratch, run_blocks
from firmware_iface.recording import CHANNELS

WIDTHS = (1, 16)
"""Those in use: one candidate, and the blocks of a search."""
CURRENT = np.concatenate(
    [
        4e-3 * np.sin(np.arange(300) * 0.05) + 0.4e-3 * np.sin(np.arange(300) * 1.1),
        np.full(400, 10e-3), np.full(400, -10e-3), np.linspace(-1e-3, 1e-3, 400),
    ]
)  # fmt: skip
"""A: sticking and slipping, flapper, spool and jack on their stops, creeping."""
EFFECTS = {
    "plain": {},
    "slack": {"backlash": 4e-6, "hysteresis": 0.03, "filter_time": 1e-4, "sampling_lead": 5e-5},
    "creeping": {"spool_stribeck": 0.01, "jack_stribeck": 5e-3, "land_lap": 1e-6},
}


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    """`run_blocks` compiled for each width, every product and every sum rounded by itself."""
    level, compiler = libraries.LEVELS.get(libraries.processor_level()), c_compiler()
    if level is None or compiler is None:
        pytest.skip("needs Linux and a C compiler")
    made, folder = {}, tmp_path_factory.mktemp("widths")
    for width in WIDTHS:
        (code,) = object_code(
            ObjectFile(
                [CFunction("run", run_blocks, SlotArguments())],
                replace(level, fast=False),
                replaced=C_FUNCTIONS | (ROUNDING_FUNCTIONS if not level.rounds else {}),
                lanes=width,
            )
        )
        file = folder / f"width{width}.so"
        file.write_bytes(link_shared(compiler, file.name, {"run.o": code}, []))
        shared = ctypes.CDLL(str(file))
        address = ctypes.cast(shared.run, ctypes.c_void_p).value
        kernel = Kernel(run_blocks.py_func, True, nogil=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(libraries, "entry_address", lambda _kernel, address=address: address)
            assert kernel._compiled
        made[width] = kernel
    return made


@pytest.mark.slow
@pytest.mark.xdist_group("widths")
@pytest.mark.parametrize("kind", ["linear", "orifice"])
@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
def test_each_width_has_the_same_bits(kernels, effects, kind):
    linear = default_actuator()
    stage = replace(linear.second_stage, kind=kind)
    actuator = replace(linear, second_stage=stage)
    rng = np.random.default_rng(5)
    zeros = np.zeros((SIGNAL_ROWS, len(CURRENT)))
    zeros[0] = 30e-6 * np.sin(np.arange(len(CURRENT)) * 0.05)
    anchor = Anchor(0.1, 3.0 * CHANNELS.spool.lsb, 90.0 * CHANNELS.spool.lsb)
    batch = batch_of(zeros, CURRENT, anchor=anchor)
    space = unknowns_of({"Kintas": 0, "FSS": 0, "FDJ": 0, **effects}, actuator)
    base = tuple(item._replace(NPL=3.0) for item in space.base)
    points = np.column_stack(
        [rng.random((19, 3)), *(np.full(19, value) for value in effects.values())]
    )
    model = SimdModel(batch, replace(space, base=base))
    found = {}
    for width, kernel in kernels.items():
        work = block_scratch(model.levels.copy(), width)
        out, anchored = np.zeros((19, *batch.weight.shape)), np.zeros(19, dtype=np.int64)
        kernel(
            batch, model.unknowns.candidates(points), np.inf, work, work.memory.ctypes.data,
            work.no_costs, anchored, out,
        )  # fmt: skip
        found[width] = out.tobytes(), anchored.tolist()
    assert sum(found[1][1]) > 0
    assert np.frombuffer(found[1][0]).std() > 1.0
    assert found[1] == found[16]
