"""Compilation of numba kernels: one decorator, a cache that cannot go stale, vector types."""
