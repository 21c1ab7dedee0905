"""From decoded frames to tests: each sample at the control tick in which it was taken."""
