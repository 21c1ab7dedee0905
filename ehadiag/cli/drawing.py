"""Draws the picture of a diagnosis, with nothing of matplotlib's that others may have laid out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ehadiag.cli.matplotlib_alone import matplotlib_alone

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.verdict import Levels

__all__ = ["can_be_drawn", "drawn"]


def can_be_drawn(diagnosis: Diagnosis) -> bool:
    """Whether there are samples, asked without loading what would draw them."""
    return any(item.samples is not None and item.samples.ticks for item in diagnosis.recordings)


def drawn(diagnosis: Diagnosis, levels: Levels) -> bytes:
    """Return the picture of a diagnosis as a PNG; see `can_be_drawn`."""
    with matplotlib_alone():
        from ehadiag.report.picture import draw_diagnosis  # noqa: PLC0415 - matplotlib is slow

    return draw_diagnosis(diagnosis, levels)
