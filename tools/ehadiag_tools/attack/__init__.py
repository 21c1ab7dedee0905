"""A second sender on a live bus, in all the ways that could turn a verdict."""
