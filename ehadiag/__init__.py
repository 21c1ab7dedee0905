"""Diagnosis of electrohydraulic actuators from a short built-in test."""
