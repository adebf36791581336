"""JAX starts the way the package starts it, whichever test comes first."""

from surgical_marl.runtime import prepare_jax

prepare_jax()
