"""A fixture for folders of tests in which a simulated unit is only a means."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ehadiag_sim.simulation import Plant, simulate
from ehadiag_tools.simulator.units import COARSE_STEP


@pytest.fixture(scope="module", autouse=True)
def coarse_step() -> Iterator[None]:
    """The simulator's own step is tested beside it; a conftest imports this."""
    with pytest.MonkeyPatch.context() as patch:
        for function in (Plant.__init__, simulate):
            patch.setitem(function.__kwdefaults__, "step", COARSE_STEP)
        yield
