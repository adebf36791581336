"""The pairs of many arms, in tiles: one tile for each pair of arms.

A loop over tiles keeps the fused engine's code as short for six arms as for two. To an engine that computes many
numbers at once it is a loop of few steps, each with all pairs of two arms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.scenes.geometry import Capsule


class Tiles:
    """Pairs of geoms by the arms that they are between.

    A tile has all geoms of an arm that are in pairs with the other arm's, [A], and all of the other's, [B].

    Args:
        model: its geoms are called `<agent>/...`.
        first: the first geom of each pair, [P].
        second: the second one.
    """

    def __init__(self, model: mujoco.MjModel, first: np.ndarray, second: np.ndarray) -> None:
        owner = [model.geom(g).name.split("/")[0] for g in range(model.ngeom)]
        pairs = list(zip(first.tolist(), second.tolist(), strict=True))
        sides: dict[tuple[str, str], tuple[list[int], list[int]]] = {}
        for pair in pairs:
            for side, geom in zip(sides.setdefault((owner[pair[0]], owner[pair[1]]), ([], [])), pair, strict=True):
                side.extend([geom] if geom not in side else [])
        width = [max(len(tile[k]) for tile in sides.values()) for k in (0, 1)]
        filled = [np.array([t[k] + t[k][-1:] * (width[k] - len(t[k])) for t in sides.values()]) for k in (0, 1)]
        self.geoms = np.unique([first, second])
        """Geoms that are in pairs, [c]; below they are numbered in this order."""

        def number(geoms: np.ndarray) -> np.ndarray:
            return np.searchsorted(self.geoms, geoms).astype(np.int32)

        self._sides = number(filled[0]), number(filled[1])  # [T, A] and [T, B]
        self._ends = number(first), number(second)  # [P] each
        tile = {arms: t for t, arms in enumerate(sides)}
        cells = [
            (tile[arms], *(side.index(geom) for side, geom in zip(sides[arms], pair, strict=True)))
            for pair in pairs
            for arms in [(owner[pair[0]], owner[pair[1]])]
        ]
        shape = (len(sides), *width)
        self.place = np.ravel_multi_index(tuple(np.array(cells).T), shape)
        """Where each pair is among the cells of all tiles, [P]."""
        self._is_pair = np.isin(np.arange(np.prod(shape)), self.place).reshape(shape)

    def each(self, of: Callable[[Capsule, Capsule, Any], Any], capsules: Capsule) -> Any:
        """Return a function's result for each tile, [T, ...].

        Args:
            of: takes the capsules of both sides, [A, 1] and [1, B], and which of their cells are pairs, [A, B].
            capsules: of `geoms`, [c].
        """

        def tile(rows: Any) -> Any:
            sides, sizes, is_pair = rows
            one, other = (
                Capsule(_at(capsules.centre, side), _at(capsules.axis, side), *size)
                for side, size in zip(sides, sizes, strict=True)
            )
            return of(jax.tree.map(lambda x: x[:, None], one), jax.tree.map(lambda x: x[None], other), is_pair)

        sizes = tuple((capsules.half[side], capsules.radius[side]) for side in self._sides)
        return jax.lax.map(tile, (self._sides, sizes, self._is_pair))

    def ends_of(self, pair: Array, capsules: Capsule) -> tuple[Capsule, Capsule]:
        """Return both capsules of some pairs [K], from those of `geoms` [c]."""
        one, other = (_at(end, pair) for end in self._ends)
        return Capsule(*(_at(part, one) for part in capsules)), Capsule(*(_at(part, other) for part in capsules))


def _at(rows: Any, which: Any) -> Array:
    """Return some rows; their numbers are in range."""
    return jnp.asarray(rows).at[which].get(mode="promise_in_bounds")
