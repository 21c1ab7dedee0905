"""Output on a terminal: lines, tables, progress, and the live view of a session."""
