"""Watching a bus with the monitoring model: second half of `ehadiag monitor`."""
