"""Thin faces of the environment: PettingZoo, Gymnasium, rsl_rl, JAX."""
