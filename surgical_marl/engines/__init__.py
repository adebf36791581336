"""Engines, which run many environments at once: `mjx` is the reference, `fused` the fast one."""
