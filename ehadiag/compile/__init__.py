"""Compilation of kernels: decorators, vector types, libraries that Python loads."""
