"""Simulated damage: to the harness of a bus, and to the frames on it."""
