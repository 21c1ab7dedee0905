"""Benchmarks: speed of the project against others, in one table."""
