"""Monitoring model: a fast model of the actuator for identification and monitoring."""
