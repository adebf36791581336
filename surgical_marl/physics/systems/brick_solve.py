"""One implicit step of soft tissue: the balance of all forces on its nodes, by conjugate gradients.

A step linearises once, about the state at its start, and solves for the displacements u of the nodes

    (mass / dt^2 + (1 + damping / dt) K + springs) u = mass (v / dt + gravity) + forces at the start

from u = dt v. The preconditioner is the inverse of the blocks of columns, which are the nodes through the thickness: a
block tridiagonal factor, since nodes are numbered along columns. But for that nothing is assembled: a product with K is
a loop over bricks. Loops over bricks and nodes are scans, since the fused engine keeps these as loops.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import FULL, LOWER, cholesky, solve_factored
from surgical_marl.physics.systems.brick import Brick, Cell, inverse_symmetric, to_modes
from surgical_marl.physics.systems.brick_grid import BrickGrid
from surgical_marl.physics.systems.rigid_motion import point_jacobian
from surgical_marl.physics.systems.system import Springs

LEFT, LEAST, HALVINGS = 0.4, 0.01, 5
"""Share of its volume that a brick keeps in a step at least; share of its volume at rest below which it loses none; and
how often displacements are halved for this before there are none."""


class Nodes(NamedTuple):
    """The motion of n nodes."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""


class Support(NamedTuple):
    """Supports of the nodes: constants, [n]."""

    fixed: np.ndarray
    """Which do not move, bool."""
    stiffness: np.ndarray
    """Of a spring to the place at rest, N/m; 0 for none."""
    rest: np.ndarray
    """The places at rest, m, [n, 3]."""


class Linear(NamedTuple):
    """A step's linear equations without springs: matrix times displacement is the force."""

    cells: Cell
    """Of every brick, [e, ...]."""
    force: Array
    """Right side: all forces at the start, and mass times v / dt, N, [n, 3]."""
    block: Array
    """Each node's own block of the matrix, N/m, lower half, [n, 6]."""
    upright: Array
    """The block of each node and the one under it, N/m, [n, 9]; 0 where either is fixed or none is."""
    inertia: Array
    """The part of it that is not elastic, N/m, [n]."""
    guess: Array
    """Displacement that the velocity at the start would give, m, [n, 3]."""


class BrickSolver:
    """The constants of a mesh of bricks, and its implicit step."""

    gravity = np.array([0.0, 0.0, -9.81], np.float32)
    """m/s2"""

    def __init__(
        self,
        grid: BrickGrid,
        brick: Brick,
        support: Support,
        damping: float = 0.0,
        iterations: int = 8,
        stiffer: Any = 1.0,
    ) -> None:
        """Collect the constants.

        Args:
            grid: mesh.
            brick: element.
            support: of the borders.
            damping: s; the force of damping is this times K times the velocity.
            iterations: of conjugate gradients.
            stiffer: factor of Young's modulus, in which all forces of bricks are linear.
        """
        self.grid, self.brick, self.support, self.iterations = grid, brick, support, iterations
        self.damping, self.stiffer = damping, stiffer
        self.free = (~support.fixed & (grid.mass > 0)).astype(np.float32)
        self.loose = not support.fixed.any()
        """True if nothing is fixed, so that the whole can move."""

    def stiffened(self, stiffer: Any) -> BrickSolver:
        """Return the solver with another factor of Young's modulus."""
        found = copy.copy(self)
        found.stiffer = stiffer
        return found

    def linearise(self, state: Nodes, dt: Any) -> Linear:
        """Return the forces on nodes and their derivatives."""
        grid, blend = self.grid, self._blend(dt)

        def begin(row: Any) -> tuple[Array, Array, Array, Array]:
            mass, support, free, x, rest, v = row
            inertia = mass / dt**2 + support
            block = inertia * jnp.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
            return mass * (v / dt + self.gravity) - support * (x - rest), block, inertia, free * dt * v

        def add(sums: tuple[Array, Array, Array], first: Array) -> tuple[tuple[Array, Array, Array], Cell]:
            nodes, upper = first + jnp.asarray(grid.offsets), first + jnp.asarray(grid.offsets[1::2])
            cell, forces = self.brick.deformed(state.position[nodes])
            own, pair = (blend * (cell.turn @ k @ cell.turn.T) for k in (self.brick.diagonal, self.brick.upright))
            force, block, upright = sums
            force = force.at[nodes].add(self.stiffer * forces, mode="promise_in_bounds")
            block = block.at[nodes].add(own[:, *LOWER], mode="promise_in_bounds")
            pair *= jnp.asarray(self.linked)[upper, None, None]
            return (force, block, upright.at[upper].add(pair.reshape(4, 9), mode="promise_in_bounds")), cell

        rows = (*self._constants, state.position, jnp.asarray(self.support.rest), state.velocity)
        force, block, inertia, guess = jax.lax.map(begin, rows)
        sums: tuple[Array, Array, Array] = force, block, jnp.zeros((grid.nodes, 9))
        sums, cells = jax.lax.scan(add, sums, jnp.asarray(grid.first))
        return Linear(cells, *sums, inertia, guess)

    @property
    def linked(self) -> np.ndarray:
        """Which nodes are free, as is the one under them, 0 or 1, [n]."""
        return np.append(np.float32(0), self.free[1:] * self.free[:-1])

    @property
    def _constants(self) -> tuple[Array, Array, Array]:
        """Mass, stiffness of the support and freedom (0 or 1) of each node, [n]."""
        return jnp.asarray(self.grid.mass), jnp.asarray(self.support.stiffness), jnp.asarray(self.free)

    def softness(self, dt: float) -> tuple[float, float]:
        """Return how many times as far as its own block alone says a node in the middle of a face gives way, at rest.

        Along the face and across it, as its neighbours move along. Of a part of the mesh: what is farther away does
        not move within a step.
        """
        grid, bottom = self.grid, self.grid.side("bottom")
        cells = np.minimum(grid.cells, [8, 8, 4])
        density = float(grid.mass.sum() / (len(grid.first) * grid.cell.prod()))
        part = BrickGrid(cells * grid.cell, np.ones(cells, bool), density)
        inertia, under = part.mass / dt**2, part.side("bottom")
        inertia[under] += self.support.stiffness[bottom].mean() + 1e9 * self.support.fixed[bottom].all()
        matrix = np.diag(np.repeat(inertia.astype(float), 3))
        own = (1 + self.damping / dt) * self.brick.stiffness
        for nodes in part.first[:, None] + part.offsets:
            places = (3 * nodes[:, None] + np.arange(3)).ravel()
            matrix[np.ix_(places, places)] += own
        (middle,) = np.flatnonzero((part.places == [*(cells[:2] // 2), cells[2]]).all(1))
        place = 3 * middle + np.arange(3)
        gives = np.linalg.solve(matrix, np.eye(len(matrix))[:, place])[place]
        x, y, z = np.diag(gives) * np.diag(matrix)[place].mean()
        return min(x, y), z

    def displacements(self, linear: Linear, springs: Sequence[Springs], guess: Array, dt: Any) -> Array:
        """Return the displacements of the nodes in a step, m, [n, 3], from a guess that leaves what is fixed."""
        return self.improved(linear, springs, guess, self.residual(linear, guess, dt), dt, self.iterations)[0]

    def residual(self, linear: Linear, u: Array, dt: Any) -> Array:
        """Return the forces that are left on nodes with displacements u, m, [n, 3], without springs: N, [n, 3]."""
        inertial = jax.lax.map(lambda row: row[0] * row[1], (linear.inertia, u))
        rows = linear.force, self._elastic(linear.cells, u, inertial, dt)
        found: Array = jax.lax.map(lambda row: row[0] - row[1], rows)
        return found

    def improved(
        self, linear: Linear, springs: Sequence[Springs], u: Array, residual: Array, dt: Any, most: Any,
        enough: float = 0.0,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return better displacements, m, [n, 3], and the forces that these leave without springs, N, [n, 3].

        Args:
            linear: the step's equations.
            springs: at points of the tissue, in lists.
            u: displacements that leave what is fixed.
            residual: the forces that these leave without springs.
            dt: duration of the step, s.
            most: most conjugate gradients.
            enough: residual at which they stop, in the norm of the inverse of the nodes' own blocks, J.
        """
        free = jnp.asarray(self.free)
        residual, block = _pushed(springs, u, residual), _stiffened(springs, linear.block)
        none, factors = jnp.zeros(3), (_factorised(block, linear.upright), linear.upright)

        def matrix(p: Array, sums: Array) -> Array:
            """Return the matrix times p, [n, 3], in the rows of `sums`, which hold inertia times p."""
            return _springs_times(springs, p, self._elastic(linear.cells, p, sums, dt))

        def up(found: tuple[Array, Array], residual: Array, factor: Any) -> tuple[tuple[Array, Array], Array]:
            """Go up a column by one node, and add its part of the norm of the residual."""
            sum_, below = found
            left = residual - factor[1].reshape(3, 3) @ below
            eased = factor[0][FULL] @ left
            return (sum_ + left @ eased, eased), eased

        def direction(eased: Array, p: Array, share: Any) -> tuple[Array, Array]:
            """Return the next direction, m, [n, 3], and inertia times that, by going down all columns."""

            def down(above: Array, row: Any) -> tuple[Array, tuple[Array, Array]]:
                eased, p, inverse, upright, inertia = row
                z = eased - inverse[FULL] @ above
                p = z + share * p
                return upright.reshape(3, 3).T @ z, (p, inertia * p)

            rows = eased, p, *factors, linear.inertia
            found: tuple[Array, Array] = jax.lax.scan(down, none, rows, reverse=True)[1]
            return found

        def begin(found: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], Any]:
            residual, free, factor = row
            residual *= free
            found, eased = up(found, residual, factor)
            return found, (residual, eased)

        (rz, _), (residual, eased) = jax.lax.scan(begin, (jnp.float32(0.0), none), (residual, free, factors))
        p, ap = direction(eased, eased, 0.0)

        def goes_on(found: Any) -> Array:
            done, *_, rz = found
            return (done < most) & (rz > enough)

        def iterate(found: Any) -> Any:
            done, u, residual, p, ap, rz = found

            def project(sums: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], Array]:
                own, p, free, inertia = row
                own *= free
                return (sums[0] + own @ p, sums[1] + inertia * (p @ p)), own

            start = jnp.float32(0.0), jnp.float32(0.0)
            (pap, least), ap = jax.lax.scan(project, start, (matrix(p, ap), p, free, linear.inertia))
            length = rz / jnp.maximum(jnp.maximum(pap, least), 1e-30)  # all but inertia adds to it, save for rounding

            def advance(found: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], Any]:
                u, residual, p, ap, factor = row
                residual -= length * ap
                found, eased = up(found, residual, factor)
                return found, (u + length * p, residual, eased)

            rows = u, residual, p, ap, factors
            (after, _), (u, residual, eased) = jax.lax.scan(advance, (jnp.float32(0.0), none), rows)
            return done + 1, u, residual, *direction(eased, p, after / jnp.maximum(rz, 1e-30)), after

        start = jnp.int32(0), u, residual, p, ap, rz
        _, u, residual, *_ = jax.lax.while_loop(goes_on, iterate, start)
        return u, _pushed(springs, u, residual, -1.0)

    def unbalanced(self, state: Nodes, linear: Linear, springs: Sequence[Springs], u: Array, dt: Any) -> Array:
        """Return the forces of all but bricks that inertia does not balance after displacements u, N, [n, 3]."""

        def one(row: Any) -> Array:
            mass, support, x, v, rest, u, inertia = row
            return mass * (v / dt + self.gravity) - support * (x - rest) - inertia * u

        mass, support, _ = self._constants
        rows = mass, support, *state, jnp.asarray(self.support.rest), u, linear.inertia
        return _pushed(springs, u, jax.lax.map(one, rows))

    def balanced(self, position: Array, left: Array, inertia: Array, springs: Sequence[Springs] = ()) -> Array:
        """Return a rigid motion of all nodes, m, [n, 3], by which forces that are left have no sum and no torque.

        Forces of bricks have neither, whatever gradients leave. So linear and angular momentum are right.

        Args:
            position: of the nodes, m, [n, 3].
            left: forces of all but bricks that are not balanced by inertia, N, [n, 3].
            inertia: by how much these fall as nodes move, N/m, [n].
            springs: by which they fall besides.
        """
        centre = position[len(position) // 2]

        def add(sums: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], None]:
            place, left, inertia = row
            moves = point_jacobian(place - centre)
            return (sums[0] + inertia * (moves.T @ moves), sums[1] + moves.T @ left), None

        sums, _ = jax.lax.scan(add, (jnp.zeros((6, 6)), jnp.zeros(6)), (position, left, inertia))

        def stiffen(own: Any, matrix: Array) -> Array:
            moves = point_jacobian(own.weights @ position[own.nodes] - centre)  # weights sum to 1
            return matrix + moves.T @ own.stiffness[FULL] @ moves

        motion = solve_factored(cholesky(_each(springs, stiffen, sums[0])), sums[1])
        rows = position, jnp.asarray(self.free)
        found: Array = jax.lax.map(lambda row: row[1] * (point_jacobian(row[0] - centre) @ motion), rows)
        return found

    def _blend(self, dt: Any) -> Any:
        """Return the factor of the stiffness K of bricks in the matrix of a step: with damping."""
        return self.stiffer * (1 + self.damping / dt)

    def _elastic(self, cells: Cell, p: Array, sums: Array, dt: Any) -> Array:
        """Return sums [n, 3] with the elastic part of the matrix times p, [n, 3]."""
        blend = self._blend(dt)

        def add(sums: Array, row: Any) -> tuple[Array, None]:
            first, cell = row
            nodes = first + jnp.asarray(self.grid.offsets)
            fall = blend * self.brick.product(cell, p[nodes])
            return sums.at[nodes].add(fall, mode="promise_in_bounds"), None

        found: Array = jax.lax.scan(add, sums, (jnp.asarray(self.grid.first), cells))[0]
        return found

    def moved(self, state: Nodes, u: Array, dt: Any) -> Nodes:
        """Return the nodes after displacements u, m, [n, 3]."""
        found: Nodes = jax.lax.map(lambda row: Nodes(row[0] + row[1], row[1] / dt), (state.position, u))
        return found

    def step(self, state: Nodes, dt: Any, springs: Sequence[Springs] = ()) -> Nodes:
        """Return the state after a step in which nothing but its supports, its weight and springs act."""
        linear = self.linearise(state, dt)
        return self.moved(state, self.displacements(linear, springs, linear.guess, dt), dt)

    def shortened(self, state: Nodes, u: Array) -> Array:
        """Return displacements u, m, [n, 3], shorter at bricks that would be crushed: `LEFT` and `LEAST` say how far.

        One linearisation does not see how fast the resistance of a crushed brick grows. Its nodes go half as far, and
        again, and do not move at last. All others go as far as they would.
        """
        offsets, bricks = jnp.asarray(self.grid.offsets), jnp.asarray(self.grid.first)

        def volume(x: Array) -> Array:
            gradient = self.brick.gradient(to_modes(x))
            return gradient[0] @ jnp.cross(gradient[1], gradient[2])

        def crushed(nodes: Array, share: Any) -> Array:
            x = state.position[nodes]
            before = volume(x)
            return volume(x + share * u[nodes]) < jnp.maximum(LEFT * before, jnp.minimum(LEAST, before))

        def look(found: Array, first: Array) -> tuple[Array, None]:
            return found | crushed(first + offsets, 1.0), None

        def halve(found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            shares, rounds, _ = found

            def mark(found: tuple[Array, Array], first: Array) -> tuple[tuple[Array, Array], None]:
                nodes, (marks, any_) = first + offsets, found
                own = shares[nodes]
                bad = (jnp.max(own) > 0) & crushed(nodes, own[:, None])
                marks = marks.at[nodes].set(marks[nodes] | bad, mode="promise_in_bounds")
                return (marks, any_ | bad), None

            (marks, any_), _ = jax.lax.scan(mark, (jnp.zeros(len(u), bool), jnp.bool_(False)), bricks)
            less = jnp.where(rounds < HALVINGS, 0.5, 0.0)
            shares = jax.lax.map(lambda row: jnp.where(row[0], less * row[1], row[1]), (marks, shares))
            return shares, rounds + 1, any_

        def shorten() -> Array:
            start = jnp.ones(len(u), jnp.float32), jnp.int32(0), jnp.bool_(True)
            shares, *_ = jax.lax.while_loop(lambda found: found[2], halve, start)
            found: Array = jax.lax.map(lambda row: row[0] * row[1], (shares, u))
            return found

        any_, _ = jax.lax.scan(look, jnp.bool_(False), bricks)
        found: Array = jax.lax.cond(any_, shorten, lambda: u)
        return found

    def stretched(self, position: Array, limit: float) -> Array:
        """Return whether any brick is stretched past a ratio of lengths, [] bool."""

        def look(found: Array, first: Array) -> tuple[Array, None]:
            gradient = self.brick.gradient(to_modes(position[first + jnp.asarray(self.grid.offsets)]))
            left = limit**2 * np.eye(3, dtype=np.float32) - gradient.T @ gradient  # positive definite below the limit
            minor = left[0, 0] * left[1, 1] - left[0, 1] * left[1, 0]
            return found | (left[0, 0] < 0) | (minor < 0) | (jnp.cross(left[0], left[1]) @ left[2] < 0), None

        found: Array = jax.lax.scan(look, jnp.bool_(False), jnp.asarray(self.grid.first))[0]
        return found


def _factorised(block: Array, upright: Array) -> Array:
    """Return the inverses of the pivots of columns, m/N, lower halves, [n, 6], from their blocks [n, 6] and [n, 9]."""

    def one(below: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        own, pair = row[0][FULL], row[1].reshape(3, 3)
        inverse = inverse_symmetric(own - pair @ below @ pair.T)
        return inverse, inverse[LOWER]

    found: Array = jax.lax.scan(one, jnp.zeros((3, 3)), (block, upright))[1]
    return found


def _each(springs: Sequence[Springs], of: Callable[[Any, Any], Any], start: Any) -> Any:
    for some in springs:
        rows = some._replace(used=some.force)

        def add(row: Array, sums: Any, rows: Springs = rows) -> Any:
            return of(jax.tree.map(lambda x: x[row], rows), sums)

        start = jax.lax.fori_loop(0, some.used, add, start)
    return start


def _pushed(springs: Sequence[Springs], u: Array, forces: Array, share: float = 1.0) -> Array:
    """Return forces on nodes, N, [n, 3], with a share of those of springs at displacements u, m, [n, 3]."""

    def add(own: Any, forces: Array) -> Array:
        force = share * (own.force - own.stiffness[FULL] @ (own.weights @ u[own.nodes]))
        for node, weight in zip(own.nodes, own.weights, strict=True):
            forces = forces.at[node].add(weight * force, mode="promise_in_bounds")
        return forces

    found: Array = _each(springs, add, forces)
    return found


def _stiffened(springs: Sequence[Springs], block: Array) -> Array:
    def add(own: Any, block: Array) -> Array:
        for node, weight in zip(own.nodes, own.weights, strict=True):
            block = block.at[node].add(weight * weight * own.stiffness, mode="promise_in_bounds")
        return block

    found: Array = _each(springs, add, block)
    return found


def _springs_times(springs: Sequence[Springs], p: Array, out: Array) -> Array:
    def add(own: Any, out: Array) -> Array:
        moved = own.weights @ p[own.nodes]
        force = own.stiffness[FULL] @ moved
        for node, weight in zip(own.nodes, own.weights, strict=True):
            out = out.at[node].add(weight * force, mode="promise_in_bounds")
        return out

    found: Array = _each(springs, add, out)
    return found
