"""Translates between frames and physical values, and checks their end-to-end protection."""
