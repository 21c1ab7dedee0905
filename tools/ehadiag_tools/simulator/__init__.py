"""Checks of the simulator: against recordings and a stiff reference solver."""
