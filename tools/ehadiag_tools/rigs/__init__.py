"""Re-records the reference recordings on foreign buses, and diagnoses them there."""
