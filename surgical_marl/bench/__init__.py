"""How fast each engine is, on the same machine, from the same states, under the same commands."""
