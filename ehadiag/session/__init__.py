"""Sessions on a bus: tests and monitoring, their state, their alarms, and the live view of them."""
