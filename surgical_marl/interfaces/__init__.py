"""Thin faces of the batched environment: PettingZoo, Gymnasium, rsl_rl."""
