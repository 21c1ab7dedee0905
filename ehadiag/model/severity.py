"""What a severity does to a physical constant, for numbers, arrays and kernels alike."""

from __future__ import annotations

from ehadiag.model.plant import Value

__all__ = ["CLOGGED", "clogged", "worn"]

CLOGGED = 0.8
"""Share of the first stage's flow gain that is lost at the limit of damage (PHY-13)."""


def clogged(gain: Value, severity: Value) -> Value:
    """Flow gain of the first stage behind a clogged filter (PHY-13)."""
    return gain * (1.0 - CLOGGED * severity)


def worn(new: Value, limit: Value, severity: Value) -> Value:
    """Dry friction between that of a new unit and that at the limit of damage (PHY-14, PHY-15)."""
    return new + severity * (limit - new)
