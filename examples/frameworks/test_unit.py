"""Built-in tests of a unit by pytest: `pytest examples/frameworks`, on a rig with
`--ehadiag-interface socketcan --ehadiag-channel can0`.
"""

import pytest


@pytest.mark.ehadiag_limits(Kintas=0.25, FSS=0.75, FDJ=0.25)
def test_unit_is_fit_for_service(ehadiag_unit, tmp_path):
    """Below the limits of the marker."""
    result = ehadiag_unit("open", record=tmp_path / "open.blf")
    assert result.severities["FSS"].value == pytest.approx(0.4, abs=0.01)


@pytest.mark.xfail(reason="the spool of this unit is worn", strict=True)
@pytest.mark.ehadiag_limits(FSS=0.25)
def test_unit_is_as_new(ehadiag_unit):
    """Fails: the spool is beyond the limit."""
    ehadiag_unit("open")
