"""Local refinement: robust least squares from the optimum of the search."""
