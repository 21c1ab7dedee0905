"""What is seen of a session while it runs: snapshots for screens, logs and web pages."""
