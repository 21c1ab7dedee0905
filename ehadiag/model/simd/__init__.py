"""Monitoring model for many candidates at once, one in each lane of the vector unit."""
