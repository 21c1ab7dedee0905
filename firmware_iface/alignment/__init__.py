"""Decoded frames onto the tick grid of a test, with counts of what was wrong."""
