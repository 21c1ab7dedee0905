"""Buses as frame sources and sinks: CAN adapters, serial link, receive thread."""
