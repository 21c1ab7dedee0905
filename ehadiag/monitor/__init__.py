"""Streaming monitor: residuals of the monitoring model and their CUSUM, one tick at a time."""

from ehadiag.monitor.free_motion import FreeMotionMonitor, undecided_spool
from ehadiag.monitor.monitor import Monitor, Reading, Tick

__all__ = ["FreeMotionMonitor", "Monitor", "Reading", "Tick", "undecided_spool"]
