"""Detailed actuator simulator and emulation of the flight-control computer on its bus."""
