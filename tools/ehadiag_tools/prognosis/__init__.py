"""Remaining life on simulated units: what the prognosis is measured by."""
