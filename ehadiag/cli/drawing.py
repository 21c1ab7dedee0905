"""Draws the picture of a diagnosis, with nothing of matplotlib's that others may have laid out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ehadiag.cli.matplotlib_alone import matplotlib_alone

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis

__all__ = ["can_be_drawn", "drawn"]


def can_be_drawn(diagnosis: Diagnosis) -> bool:
    """Whether there is a modelled response, of numbers."""
    found = diagnosis.identification
    return found is not None and all(math.isfinite(item.value) for item in found.estimates)


def drawn(diagnosis: Diagnosis) -> bytes:
    """Return the picture of a diagnosis as a PNG; see `can_be_drawn`."""
    with matplotlib_alone():
        from ehadiag.report.picture import draw_diagnosis  # noqa: PLC0415 - matplotlib is slow

    return draw_diagnosis(diagnosis)
