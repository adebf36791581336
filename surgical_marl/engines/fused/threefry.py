"""JAX's random numbers: Threefry-2x32 with 20 rounds, written once for numpy arrays and for the values of a graph.

J. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011. It does not import JAX, because that alone
takes longer than the start of a warm engine.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA


def threefry(
    key: tuple[Any, Any],
    counter: tuple[Any, Any],
    add: Callable[[Any, Any], Any],
    xor: Callable[[Any, Any], Any],
    rotate: Callable[[Any, int], Any],
    number: Callable[[int], Any],
) -> tuple[Any, Any]:
    """Return two random words for two words of a counter.

    Args:
        key: two words of 32 bits.
        counter: two words of 32 bits.
        add: the sum of two words, modulo 2^32.
        xor: the exclusive or of two words.
        rotate: a word turned left by so many bits.
        number: the word of a Python int.
    """
    keys = [*key, xor(xor(*key), number(PARITY))]
    x, y = add(counter[0], keys[0]), add(counter[1], keys[1])
    for block in range(5):
        for distance in ROTATIONS[block % 2]:
            x = add(x, y)
            y = xor(rotate(y, distance), x)
        x = add(x, keys[(block + 1) % 3])
        y = add(add(y, keys[(block + 2) % 3]), number(block + 1))
    return x, y


def episode_keys(seed: int, count: int, first: int = 0) -> np.ndarray:
    """Return the keys of `count` environments of a seed, [count, 2] uint32, for environments `first`, `first` + 1, ...

    They are `jax.random.fold_in(key, first + i)`, where the two words of `key` are the upper and the lower 32 bits of
    the seed. Below 2^32 that is `jax.random.PRNGKey(seed)`; beyond, `PRNGKey` drops the upper word unless JAX computes
    with 64 bits.
    """
    key = np.array([seed >> 32 & 0xFFFFFFFF], np.uint32), np.array([seed & 0xFFFFFFFF], np.uint32)
    counter = np.zeros(count, np.uint32), np.arange(first, first + count, dtype=np.uint32)
    return np.stack(threefry(key, counter, operator.add, operator.xor, _rotate, np.uint32), -1)


def _rotate(words: np.ndarray, distance: int) -> np.ndarray:
    return words << np.uint32(distance) | words >> np.uint32(32 - distance)
