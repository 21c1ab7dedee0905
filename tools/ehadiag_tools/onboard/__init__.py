"""Exported libraries run on this computer and in emulators, and compared bit by bit."""
