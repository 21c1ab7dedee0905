"""Maps the messages and signals of a DBC to the roles that they play here."""
