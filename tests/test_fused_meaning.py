"""What the fused engine's compiler makes of a JAX function, before any code is written, means what JAX says."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import numpy as np
import pytest

from tests.helpers.fused_blocks import all_blocks, random_arrays
from tests.helpers.fused_kernels import make_stores
from tests.test_fused_schedule import Direct


@cache
def meant(group: str) -> tuple[Any, Any, Any]:
    """The graph of all blocks of a group, the values of its results, and what it is given."""
    columns = random_arrays(0)
    graph, stores, _, inputs, _ = make_stores(partial(all_blocks, group), (columns,))
    return graph, [value for _, _, value in stores], inputs


@pytest.mark.parametrize("group", ["a", "f", "m", "r", "x"])
def test_the_values_of_every_block_are_those_of_jax(group: str) -> None:
    """In three environments, by numpy on one value after the other."""
    graph, values, inputs = meant(group)
    columns = random_arrays(0)
    expected = jax.jit(jax.vmap(partial(all_blocks, group)))(columns)
    for which in range(3):
        loads = {
            (leaf.buffer, leaf.first + k): element
            for leaf, column in zip(jax.tree.leaves(inputs), jax.tree.leaves((columns,)), strict=True)
            for k, element in enumerate(column[which].ravel())
        }
        direct = Direct(graph, loads)
        found = iter(values)
        for name, column in sorted(expected.items()):
            mine = np.array([direct(next(found)) for _ in column[which].ravel()], column.dtype)
            np.testing.assert_allclose(mine, np.ravel(column[which]), rtol=1e-5, atol=1e-6, err_msg=name)
