"""Benchmarks of the engines, on the same machine, from the same states, under the same commands."""
