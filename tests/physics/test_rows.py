"""Rows of trees of arrays."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.physics.tree_utils import picked, row_of

shapes = st.lists(st.lists(st.integers(1, 3), max_size=2).map(tuple), min_size=1, max_size=3)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), shapes, st.data())
def test_a_row_out_of_one_flat_array_is_the_row(rows: int, shapes: list[tuple[int, ...]], data: st.DataObject) -> None:
    rng, i = np.random.default_rng(0), data.draw(st.integers(0, rows - 1))
    tree = {str(n): jnp.asarray(rng.normal(size=(rows, *shape)), jnp.float32) for n, shape in enumerate(shapes)}
    jax.tree.map(np.testing.assert_array_equal, picked(tree, jnp.int32(i)), row_of(tree, i))
