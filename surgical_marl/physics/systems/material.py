"""Points of a mesh of bricks by their place in the material, and the other way round.

A place in the material is three numbers: how many bricks from the corner of the grid along x, y and z. Each brick falls
into six tetrahedra around its diagonal (Kuhn's), and in these the map to the world is linear. So a point hangs on four
nodes, and neighbouring bricks agree on their faces. Outside of the grid the map of the outermost bricks goes on.

    spot = material.spot(at)                             # nodes and weights
    at = material.locate(position, guess, place)         # by nodes that are at `position`
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.systems.brick_grid import BrickGrid
from surgical_marl.physics.systems.system import Spot

REPETITIONS = 4
"""Newton steps to locate a place. The map is linear but for what is between a guess and the place."""
BESIDE = 2.0
"""Distance from the grid up to which places are told apart, in bricks."""


class Material:
    """The map between the material of a mesh and the world."""

    def __init__(self, grid: BrickGrid) -> None:
        self.cells, self.cell = grid.cells, grid.cell.astype(np.float32)
        self._strides = grid.offsets[[4, 2, 1]]
        self._present = np.pad(grid.present, 1).ravel()
        self._around = np.array([(self.cells[1] + 2) * (self.cells[2] + 2), self.cells[2] + 2, 1], np.int32)

    def spot(self, at: Array) -> Spot:
        """Return the nodes of a place in the material, [3]."""
        nodes, shares, _ = self._tetrahedron(at)
        return Spot(nodes, shares)

    def place(self, position: Array, at: Array) -> Array:
        """Return where a place in the material is in the world, m, [3], by the positions of the nodes, m, [n, 3]."""
        nodes, shares, _ = self._tetrahedron(at)
        return shares @ position[nodes]

    def slopes(self, position: Array, at: Array) -> Array:
        """Return the gradients of the three numbers of a place in the world, 1/m, [3, 3]: a row for each."""
        nodes, _, ranks = self._tetrahedron(at)
        return _slopes(position[nodes], ranks)

    def surface(self, position: Array, face: Array, touch: Array) -> tuple[Array, Array]:
        """Return the place of a point of a face in the world, m, [3], and the unit vector inwards there, [3].

        Args:
            position: of the nodes, m, [n, 3].
            face: twice the axis that it is across, plus 1 if inwards is down along it.
            touch: the point's place in the material, [3].
        """
        sign = 1.0 - 2.0 * (face % 2)
        axis = (np.arange(3) == face // 2).astype(jnp.float32)
        slopes = self.slopes(position, touch + 1e-3 * sign * axis)
        inwards = sign * (axis @ slopes)
        return self.place(position, touch), inwards / jnp.sqrt(jnp.maximum(inwards @ inwards, 1e-12))

    def locate(self, position: Array, guess: Array, place: Array) -> Array:
        """Return the place in the material [3] that is at a place in the world, m, [3], beginning at a guess."""
        far = self.cells + BESIDE

        def improve(_: int, at: Array) -> Array:
            nodes, shares, ranks = self._tetrahedron(at)
            corners = position[nodes]
            step = _slopes(corners, ranks) @ (place - shares @ corners)
            return jnp.clip(at + jnp.clip(step, -1.0, 1.0), -BESIDE, far)

        found: Array = jax.lax.fori_loop(0, REPETITIONS, improve, guess)
        return found

    def there(self, brick: Array) -> Array:
        """Return whether there is a brick at these three whole numbers, [3]."""
        inside = jnp.clip(brick + 1, 0, self.cells + 1)
        return jnp.asarray(self._present)[inside @ jnp.asarray(self._around)]

    def distance(self, one: Array, other: Array) -> Array:
        """Return the distance of two places at rest, m."""
        way = (one - other) * self.cell
        return jnp.sqrt(way @ way)

    def _tetrahedron(self, at: Array) -> tuple[Array, Array, Array]:
        """Return the nodes [4] around a place, their shares [4], and the axes from the first node to the last, [3]."""
        brick = jnp.clip(jnp.floor(at), 0, self.cells - 1)
        x, y, z = at - brick
        first = jnp.where((x >= y) & (x >= z), 0, jnp.where(y >= z, 1, 2))
        last = jnp.where((z <= y) & (z <= x), 2, jnp.where(y <= x, 1, 0))
        ranks = jnp.stack([first, 3 - first - last, last])
        steps = jnp.asarray(self._strides)[ranks]
        corner = brick.astype(jnp.int32) @ jnp.asarray(self._strides)
        nodes = corner + jnp.stack([0 * steps[0], steps[0], steps[0] + steps[1], steps[0] + steps[1] + steps[2]])
        a, b, c = (at - brick)[ranks]
        return nodes, jnp.stack([1 - a, a - b, b - c, c]), ranks


def _slopes(corners: Array, ranks: Array) -> Array:
    """Return the inverse of the gradient in a tetrahedron, 1/m, [3, 3], from its corners, m, [4, 3]."""
    a, b, c = corners[1:] - corners[:-1]
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    volume = a @ rows[0]
    least = 1e-3 * jnp.sqrt((a @ a) * (b @ b) * (c @ c))
    rows /= jnp.where(jnp.abs(volume) > least, volume, jnp.inf)  # a flat one tells nothing
    return jnp.zeros((3, 3)).at[ranks].set(rows, mode="promise_in_bounds")
