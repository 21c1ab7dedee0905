"""Remaining useful life: how long until a severity reaches a level, from the health history."""
