"""The finite element of soft tissue: a brick of eight nodes that turns with the tissue (corotational).

In a frame that turns with it, a brick is linearly elastic. Trilinear displacements alone would make it far too stiff in
bending: they can not take the shape of an arc. So it has nine more displacements of its own, quadratic ones, which no
neighbour shares and which are eliminated beforehand (E. L. Wilson et al., 1973; R. L. Taylor's correction of 1976
changes nothing in a brick, whose sides are at right angles). `docs/studies/tissue_mesh.py` compares it with others.

The displacements of eight nodes are eight modes in each direction: a translation, three of the mean gradient F, and
four others, which bend and twist the brick without a mean strain (hourglass modes). In these modes the stiffness matrix
falls apart into Hooke's law for the mean strain and a few small blocks for the others, so a product takes 300
operations instead of 1,152.

    brick = Brick(size, young, poisson)
    cell, forces = brick.deformed(x)           # one element, its nodes at x [8, 3]; N, [8, 3]
    falls = brick.product(cell, u)             # by how much these forces fall as nodes move by u [8, 3]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import FULL, LOWER
from surgical_marl.physics.systems.rigid_motion import rotation

CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
"""Where the nodes of a brick are, in its sides, [8, 3]; modes are in the same order: 4 is the gradient along x."""
GRADIENTS, HOURGLASSES = (4, 2, 1), (3, 5, 6, 7)
"""Modes along x, y, z; and those of the products yz, xz, xy and xyz."""
EVENED, ITERATIONS = 2, 2
"""How often the stretches of a gradient are evened out for a first rotation, and Newton steps from there: it is then
exact to rounding for any brick whose sides have ratios below 150."""
CRUSHED, RESISTANCE = 0.4, 2.0
"""Share of its volume below which a brick resists compression more than linearly, and how much: the pressure in Young's
moduli at half that share. It grows to 64 times as much."""
_SIGNS = 2 * CORNERS - 1
_EYE = np.eye(3, dtype=np.float32)


# -- the stiffness matrix, float64


def elasticity(young: float, poisson: float) -> np.ndarray:
    """Return the stresses by strains, Pa, [6, 6]: xx, yy, zz, and shear angles xy, yz, zx (Hooke's law)."""
    lame, shear = lame_constants(young, poisson)
    return np.diag([2 * shear] * 3 + [shear] * 3) + lame * np.pad(np.ones((3, 3)), (0, 3))


def lame_constants(young: float, poisson: float) -> tuple[float, float]:
    """Return lambda and the shear modulus, Pa."""
    return young * poisson / (1 + poisson) / (1 - 2 * poisson), young / 2 / (1 + poisson)


def strains(gradients: np.ndarray) -> np.ndarray:
    """Return the strains by displacements of n functions with these gradients [n, 3]: [6, 3 n]."""
    found = np.zeros((6, len(gradients), 3))
    for row in range(3):
        after = (row + 1) % 3
        found[row, :, row] = gradients[:, row]
        found[3 + row, :, row], found[3 + row, :, after] = gradients[:, after], gradients[:, row]
    return found.reshape(6, -1)


def gauss_points() -> Iterator[np.ndarray]:
    """Yield the eight points of a brick, each coordinate from -1 to 1, at which integrands are summed."""
    for corner in _SIGNS:
        yield corner / np.sqrt(3)


def nodal_strains(point: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the strains at a point [3] of a brick of a size, m, [3], by displacements of its nodes, [6, 24]."""
    factors = (1 + _SIGNS * point) / 2
    return strains(np.stack([_SIGNS[:, a] * np.delete(factors, a, 1).prod(1) / size[a] for a in range(3)], 1))


def quadratic_strains(point: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the strains likewise by the displacements 1 - x^2, 1 - y^2 and 1 - z^2 in each direction, [6, 9]."""
    return strains(np.diag(-4 * point / size))


def condensed(
    size: np.ndarray, law: np.ndarray, *operators: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the stiffness matrix of a brick, N/m, [24, 24], with all but the nodes' displacements eliminated.

    Args:
        size: of the brick, m, [3].
        law: stresses by strains, Pa, [6, 6].
        operators: functions of a point and the size that return strains: of the nodes first; the others are eliminated.
    """
    whole: np.ndarray = sum(
        b.T @ law @ b * np.prod(size) / 8
        for b in (np.concatenate([of(point, size) for of in operators], 1) for point in gauss_points())
    )
    nodes, inner, cross = whole[:24, :24], whole[24:, 24:], whole[:24, 24:]
    return nodes - cross @ np.linalg.solve(inner, cross.T) if len(inner) else nodes


def stiffness(size: np.ndarray, young: float, poisson: float) -> np.ndarray:
    """Return the stiffness matrix of a brick of a size, m, [3], at rest, N/m, [24, 24]."""
    return condensed(np.asarray(size, float), elasticity(young, poisson), nodal_strains, quadratic_strains)


# -- one element, float32


class Cell(NamedTuple):
    """One deformed brick: all that a step needs of it."""

    turn: Array
    """Its rotation, [3, 3]."""
    spin: Array
    """Stiffness of its stress against rotation, Pa, symmetric, positive semidefinite: [6]."""
    crush: Array
    """Resistance to being crushed, beyond Hooke's law: square root of Pa times derivative of the volume, [6]."""


class Brick:
    """The constants of bricks of one size and material."""

    def __init__(self, size: np.ndarray, young: float, poisson: float) -> None:
        self.size = np.asarray(size, float)
        self.volume, self.young = float(np.prod(size)), young
        self.lame, self.shear = lame_constants(young, poisson)
        signs = np.stack([np.prod(np.where(mode, -_SIGNS, 1), 1) for mode in CORNERS])  # [mode, node]
        self._slope = np.float32(-2 / self.size)
        self.stiffness = stiffness(self.size, young, poisson)
        """At rest, N/m, [24, 24]."""
        whole = self.stiffness.reshape(8, 3, 8, 3)
        modal = np.einsum("sa,aibj,tb->sitj", signs, whole, signs)
        self.hourglass = modal[np.ix_(HOURGLASSES, range(3), HOURGLASSES, range(3))].reshape(12, 12).astype(np.float32)
        """Of the hourglass modes, [12, 12], mostly zeros."""
        self.hourglass[np.abs(self.hourglass) < 1e-6 * np.abs(self.hourglass).max()] = 0.0
        self.diagonal = np.einsum("aiaj->aij", whole).astype(np.float32)
        """Of each node, at rest, N/m, [8, 3, 3]."""
        self.upright = np.einsum("aiaj->aij", whole[1::2, :, ::2]).astype(np.float32)
        """Of each upper node and the one under it, at rest, N/m, [4, 3, 3]."""

    def deformed(self, x: Array) -> tuple[Cell, Array]:
        """Return a brick whose nodes are at x, m, [8, 3], and the forces on these, N, [8, 3]."""
        modes = to_modes(x)
        gradient = self.gradient(modes)
        turn = polar_rotation(gradient)
        stretch = turn.T @ gradient
        stretch = (stretch + stretch.T) / 2
        cofactors = _cofactors(stretch)
        volume = jnp.sum(stretch[0] * cofactors[0])
        lost = jnp.maximum(CRUSHED - volume, 0.0) / jnp.maximum(volume, CRUSHED / 8)
        pressure = RESISTANCE * self.young * lost**2
        stiff = 2 * RESISTANCE * self.young * lost * CRUSHED / jnp.maximum(volume, CRUSHED / 8) ** 2
        grown = jnp.trace(stretch) - 3.0
        stress = 2 * self.shear * (stretch - _EYE) + self.lame * grown * _EYE - pressure * cofactors

        warped = modes[HOURGLASSES, :] @ turn
        resists = _times(self.hourglass, warped)
        slow = inverse_symmetric(jnp.trace(stretch) * _EYE - stretch)  # turns, by the skew part of a change of F
        torque = slow @ jnp.sum(jnp.cross(resists, warped), 0)
        forces = self._forces(turn, self.volume * stress + _skew(torque), resists)
        spin = jnp.add(self.shear * _EYE, (self.lame * grown - 2 * self.shear) * slow)
        return Cell(turn, positive(spin)[LOWER], jnp.sqrt(stiff) * cofactors[LOWER]), -forces

    def product(self, cell: Any, u: Array) -> Array:
        """Return by how much the forces on the nodes fall, N, [8, 3], as these move by u, m, [8, 3].

        Symmetric and positive semidefinite: exact for the mean strain but where stress is compressive; the hourglass
        modes' own stress does not turn.
        """
        modes = to_modes(u)
        change = cell.turn.T @ self.gradient(modes)
        lost, crush = cell.crush[FULL], jnp.sum(cell.crush[FULL] * change)
        stress = self.shear * (change + change.T) + self.lame * jnp.trace(change) * _EYE + crush * lost
        turned = jnp.stack([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]])
        stress += _skew(cell.spin[FULL] @ turned)
        return self._forces(cell.turn, self.volume * stress, _times(self.hourglass, modes[HOURGLASSES, :] @ cell.turn))

    def gradient(self, modes: Array) -> Array:
        """Return the mean gradient [3, 3] of modes [8, 3]."""
        return modes[GRADIENTS, :].T * self._slope

    def _forces(self, turn: Array, stress: Array, hourglass: Array) -> Array:
        """Return nodal forces [8, 3] of a stress times volume, N m, [3, 3], and forces of hourglass modes [4, 3]."""
        columns = turn @ (stress * self._slope)
        bent = hourglass @ turn.T
        modes: list[Any] = [jnp.zeros(3)] * 8
        for mode, row in zip((*GRADIENTS, *HOURGLASSES), (*columns.T, *bent), strict=True):
            modes[mode] = row
        return to_modes(jnp.stack(modes))


def to_modes(nodes: Array) -> Array:
    """Return the modes [8, 3] of values at nodes [8, 3]: an eighth of their Hadamard transform, its own transpose."""
    cube = nodes.reshape(2, 2, 2, 3) / 8
    for axis in range(3):
        low, high = jnp.take(cube, 0, axis), jnp.take(cube, 1, axis)
        cube = jnp.stack([low + high, low - high], axis)
    return cube.reshape(8, 3)


def polar_rotation(gradient: Array) -> Array:
    """Return the rotation [3, 3] nearest to a gradient [3, 3], also of a brick that is turned inside out.

    Newton's method for the largest trace of the stretch. It may find another extremum of that from a frame that is far
    off, as that of a brick's edges is where they are nearly parallel. Forces would be those of a brick that is turned
    inside out twice. So Newton's method starts from a gradient of nearly equal stretches with the same rotation: steps
    of Higham's iteration for the polar decomposition, scaled (N. J. Higham, 1986), make it.
    """

    def even(_: Any, gradient: Array) -> Array:
        cofactors = _cofactors(gradient)
        return gradient / _norm(gradient) + cofactors / _norm(cofactors)

    evened = jax.lax.fori_loop(0, EVENED, even, gradient)
    first = evened[:, 0] / _norm(evened[:, 0])
    third = jnp.cross(first, evened[:, 1])
    third /= _norm(third)
    start = jnp.stack([first, jnp.cross(third, first), third], 1)

    def improve(_: Any, turn: Array) -> Array:
        stretch = turn.T @ gradient
        skew = jnp.stack([stretch[2, 1] - stretch[1, 2], stretch[0, 2] - stretch[2, 0], stretch[1, 0] - stretch[0, 1]])
        half = inverse_symmetric(jnp.trace(stretch) * _EYE - (stretch + stretch.T) / 2) @ skew / 2
        quaternion = jnp.concatenate([jnp.ones(1), half / jnp.maximum(1.0, _norm(half))])
        return turn @ rotation(quaternion / _norm(quaternion))

    found: Array = jax.lax.fori_loop(0, ITERATIONS, improve, start)
    return found


def inverse_symmetric(matrix: Array) -> Array:
    """Return the inverse of a symmetric, positive definite matrix [3, 3]; of others something finite."""
    cofactors = _cofactors(matrix)
    return cofactors / jnp.maximum(jnp.sum(matrix[0] * cofactors[0]), 1e-6)


def positive(matrix: Array) -> Array:
    """Return a symmetric matrix [3, 3], its diagonal raised until Gershgorin's circles are not negative."""
    own = jnp.diagonal(matrix)
    least = own + jnp.abs(own) - jnp.sum(jnp.abs(matrix), 1)
    return matrix + jnp.diag(jnp.maximum(-least, 0.0))


def _cofactors(m: Array) -> Array:
    return jnp.stack([jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])])


def _skew(vector: Array) -> Array:
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def _norm(x: Array) -> Array:
    """Return the length of a vector, or the Frobenius norm of a matrix."""
    return jnp.sqrt(jnp.maximum(jnp.sum(x * x), 1e-24))


def _times(matrix: np.ndarray, modes: Array) -> Array:
    """Return a constant matrix [12, 12] times modes [4, 3]."""
    return jnp.reshape(matrix @ modes.ravel(), (4, 3))
