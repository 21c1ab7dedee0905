"""Emulated flight-control computer: control law, handshake, telemetry."""
