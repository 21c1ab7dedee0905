"""Data that every layer shares: channels, actuator, stored test, recording, errors."""
