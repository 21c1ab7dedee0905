"""Assessment: whether data and fit can carry a verdict, and which verdict."""
