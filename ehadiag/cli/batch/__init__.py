"""Many recordings in one call: their names, the workers, and what is told of all of them."""
