"""The kernels as plain Python give what the compiled ones give."""

import os
import subprocess
import sys

import numpy as np

from ehadiag.model.anchor import Anchor
from ehadiag.model.scalar.response import respond
from ehadiag_tools.damaged import damaged_unit

SCRIPT = """
import sys
import numba, numpy as np
from ehadiag.model.anchor import Anchor
from ehadiag.model.scalar.response import respond
from ehadiag.model.plant import PlantConstants

assert numba.config.DISABLE_JIT
current, measured = np.loadtxt(sys.stdin)
constants = PlantConstants(*map(float, sys.argv[1:]))
anchor = Anchor(0.3, 3e-7, 1.5e-6)
answer = respond(constants, current, 1e-3, measured=measured, anchor=anchor)
for row in (answer.spool, answer.pressure, answer.position, [answer.anchored]):
    print(*[float(x).hex() for x in row])
"""


def test_plain_python_gives_the_compiled_answer():
    """Steps, slow motion and a sample that re-anchors, over 60 ticks."""
    current = np.concatenate([np.zeros(2), np.full(8, 8e-3), 1.5e-3 * np.sin(np.arange(50) * 0.4)])
    constants = damaged_unit([0.3, 0.6, 0.3])
    measured = respond(constants, current, 1e-3).spool + 0.1e-6
    measured[30:] += 3e-6
    compiled = respond(
        constants, current, 1e-3, measured=measured, anchor=Anchor(0.3, 3e-7, 1.5e-6)
    )
    text = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in (current, measured))
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *map(repr, constants)],
        input=text,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )
    rows = [[float.fromhex(x) for x in line.split()] for line in done.stdout.splitlines()]
    assert compiled.anchored == rows[3][0] >= 1
    # The compiler may join a product and a sum into one rounding.
    np.testing.assert_allclose(rows[0], compiled.spool, atol=1e-14)
    np.testing.assert_allclose(rows[1], compiled.pressure, atol=1e-2)
    np.testing.assert_allclose(rows[2], compiled.position, atol=1e-13)
