"""Frames to physical values and back, with end-to-end protection checked."""
