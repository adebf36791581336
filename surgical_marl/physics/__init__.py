"""The dynamics of a scene, in pure JAX."""
