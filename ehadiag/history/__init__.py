"""Health history: every diagnosis of every unit, appended to one SQLite file and never changed."""
