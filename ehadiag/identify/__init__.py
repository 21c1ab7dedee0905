"""Identification: first approximation, genetic algorithm, refinement, uncertainty."""
