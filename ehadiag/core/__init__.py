"""Data that every layer shares: actuator, converters, criteria of a verdict, conventions."""
