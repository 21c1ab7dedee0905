"""Acquisition over CAN and serial links: frames in, validated and aligned samples out."""
