"""Design of the CUSUM against published tables and against white noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.core.errors import ConfigurationError
from ehadiag.model.scalar.response import FREE_RUN
from ehadiag.monitor import Monitor, Tick
from ehadiag.monitor.cusum import SUMS, CusumDesign, design_cusum, mean_run_length


@pytest.mark.parametrize(("threshold", "length"), [(4.0, 168.0), (5.0, 465.0)])
def test_run_length_of_the_literature(threshold, length):
    """Two-sided, k = 0.5: Montgomery, Introduction to Statistical Quality Control, table 9.3."""
    two_sided = mean_run_length(CusumDesign(0.5, threshold)) / 2.0
    assert two_sided == pytest.approx(length, rel=0.02)


@given(st.floats(1.0, 1e6), st.floats(0.2, 4.0), st.floats(1e-4, 1e-2))
def test_design_meets_the_rate(hours, shift, tick):
    design = design_cusum(hours, tick, shift)
    assert design.reference == shift / 2.0
    assert mean_run_length(design) * tick / SUMS == pytest.approx(hours * 3600.0, rel=1e-6)


def test_no_threshold_for_a_rate_too_high():
    with pytest.raises(ConfigurationError, match="no threshold"):
        design_cusum(1e-4, 0.1, 5.0)


def count_alarms(mean_ticks, pushes, seed, shift=1.0):
    """Alarms of a monitor on an actuator at rest; its sensors show white noise of known size."""
    noise = SPOOL.lsb, PRESSURE.lsb
    monitor = Monitor(
        default_actuator(),
        (0.0, 0.0, 0.0),
        hours=mean_ticks * 1e-3 / 3600.0,
        shift=shift,
        noise=noise,
        anchor=FREE_RUN,
    )
    rng = np.random.default_rng(seed)
    alarms = np.zeros((2, 2), dtype=int)
    for _ in range(pushes // 10_000):
        spool, pressure = (rng.standard_normal((10_000, 2)) * noise).T.tolist()
        for x, p in zip(spool, pressure, strict=True):
            alarmed = monitor.push(Tick(0.0, 0.0, x, p, 0.0)).alarmed
            if alarmed.any():
                alarms += alarmed
    return alarms


def test_false_alarms_come_at_about_the_stated_rate():
    alarms = count_alarms(1000, 200_000, seed=1)
    assert alarms.sum() == pytest.approx(200, rel=0.35)  # 5 standard deviations
    assert (alarms > 20).all()


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_false_alarms_come_at_the_stated_rate(shift):
    """About 1500 alarms, each sum its quarter: 2.6 % by chance, some per cent by Siegmund."""
    alarms = count_alarms(2000, 3_000_000, seed=2, shift=shift)
    assert alarms.sum() == pytest.approx(1500, rel=0.15)
    np.testing.assert_allclose(alarms / alarms.sum(), 0.25, atol=0.05)
