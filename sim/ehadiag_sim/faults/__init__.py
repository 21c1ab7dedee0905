"""Harness faults: what a damaged bus does to frames."""
