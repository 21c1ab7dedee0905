"""Calibration: what recordings of a unit as new teach about it, as an actuator file of its own."""
