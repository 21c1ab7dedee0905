"""Which messages and signals of a DBC play which role: mapping file, DBC, units."""
