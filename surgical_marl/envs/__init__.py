"""A task on a scene: one environment in pure JAX, and many at once."""
