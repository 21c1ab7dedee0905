"""What a test can tell of an actuator, and a better test within given limits."""
