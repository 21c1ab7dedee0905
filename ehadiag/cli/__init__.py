"""Command line `ehadiag`."""
