"""What is in SI is read in the units of the workshop."""

from __future__ import annotations

import pytest

from ehadiag.core.shown_in import told
from ehadiag.model.parameters import REGISTRY


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (4e-4, "A", "0.4 mA"),
        (2.5e-6, "m", "2.5 µm"),
        (0.0123, "1", "1.23 %"),
        (1e6, "Pa", "1 MPa"),
        (-466.9, "Pa", "-0.4669 kPa"),
        (300.0, "N", "300 N"),
    ],
)
def test_numbers_are_told_with_a_unit(value: float, unit: str, words: str) -> None:
    assert told(value, unit) == words


def test_no_parameter_is_told_in_the_unit_1() -> None:
    assert not [item.name for item in REGISTRY if told(1.0, item.unit).endswith(" 1")]
