"""Long runs on a loaded bus: losses, memory, latency."""
