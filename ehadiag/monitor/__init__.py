"""Streaming monitor: residuals of the monitoring model and their CUSUM, one tick at a time."""

from ehadiag.monitor.streaming import FreeMotionMonitor, Monitor, Reading, Tick, undecided_spool

__all__ = ["FreeMotionMonitor", "Monitor", "Reading", "Tick", "undecided_spool"]
