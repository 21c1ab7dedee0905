"""Buses as sources and sinks of frames: CAN adapters, serial link, receive thread."""
