"""Global search: the three one-dimensional searches and the genetic algorithm."""
