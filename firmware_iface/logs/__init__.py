"""Recordings on disk: reading, writing and replaying frames."""
