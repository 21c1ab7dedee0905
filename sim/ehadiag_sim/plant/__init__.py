"""Detailed simulator of servovalve, jack and sensors."""
