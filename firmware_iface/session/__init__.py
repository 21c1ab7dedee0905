"""Running a built-in test on a bus: handshake, limits, recording, bus report."""
