"""Acceptance of unit 7: `pytest test_unit7.py --junit-xml unit7.xml`."""

import pytest


@pytest.mark.ehadiag_limits(Kintas=0.25, FSS=0.75, FDJ=0.25)
def test_unit_7_is_fit_for_service(ehadiag_unit):
    """All severities below their limits, interval included."""
    ehadiag_unit("open", mapping="rig.toml", actuator="unit-7.toml")
