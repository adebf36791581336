"""The random keys of environments, those of JAX, without JAX: its start alone takes longer than a warm engine's."""

from __future__ import annotations

import numpy as np

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)


def episode_keys(seed: int, count: int, first: int = 0) -> np.ndarray:
    """`jax.random.fold_in(jax.random.PRNGKey(seed), first + i)` for i = 0 to count - 1, [count, 2] uint32.

    The engine that JAX runs, MJX, has the same keys.
    """
    key = np.array([0, seed & 0xFFFFFFFF], np.uint32)  # JAX takes 32 bits of a seed
    return np.stack(_threefry(key, np.zeros(count, np.uint32), np.arange(first, first + count, dtype=np.uint32)), -1)


def _threefry(key: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Threefry-2x32 with 20 rounds (Salmon et al. 2011, Parallel random numbers: as easy as 1, 2, 3)."""
    keys = [key[0], key[1], key[0] ^ key[1] ^ PARITY]
    x, y = x + keys[0], y + keys[1]
    for turn in range(5):
        for distance in ROTATIONS[turn % 2]:
            x = x + y
            y = x ^ (y << np.uint32(distance) | y >> np.uint32(32 - distance))
        x = x + keys[(turn + 1) % 3]
        y = y + keys[(turn + 2) % 3] + np.uint32(turn + 1)
    return x, y
