"""A local web page: the running session, the reports and the health history of its units."""
