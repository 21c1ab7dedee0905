"""The simulated unit takes a coarse step: its accuracy is tested beside the plant."""

from coarse_simulation import coarse_step

__all__ = ["coarse_step"]
