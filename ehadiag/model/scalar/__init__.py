"""Monitoring model for one candidate at a time: the kernels of the streaming monitor."""
