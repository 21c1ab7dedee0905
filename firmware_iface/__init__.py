"""Acquisition over CAN and serial links: frames in, validated and aligned samples out."""

FREE_MOTION = "free motion"
"""In place of a test's name: what was found without one. No stored test has this name."""
