"""Settings of hypothesis for all tests."""

from __future__ import annotations

from hypothesis import settings

# An example's time says nothing on a machine that other work shares.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
