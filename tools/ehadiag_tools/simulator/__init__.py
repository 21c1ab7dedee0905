"""Units and their recordings, by the detailed simulator."""
