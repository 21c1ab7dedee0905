"""Streaming monitor: residuals of the monitoring model and their CUSUM, one tick at a time."""

from ehadiag.monitor.monitor import Monitor, Reading, Tick

__all__ = ["Monitor", "Reading", "Tick"]
