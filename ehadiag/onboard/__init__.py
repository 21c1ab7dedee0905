"""Identification of a recorded test in fixed memory, in slices: for the computer on board."""
