"""The kernels for computers without Python: static and shared libraries, co-simulation units."""
