"""How a scene moves, in pure JAX."""
