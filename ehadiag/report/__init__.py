"""Verdict, machine-readable and human-readable results."""
