"""Contact with Coulomb friction: the acceleration at which all forces balance, by Newton's method.

A contact is a stiff spring along its normal, and friction a stiff spring or damper that slips when its force reaches
the friction coefficient times the normal force. All forces are those at the end of the step: an implicit step can not
overshoot, however light an object is. Together they minimise a convex function of the acceleration, as in `solver.py`:
the forces of a patch are the nearest ones in its friction cone to those that would stick. docs/physics.md says more.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.solver import Rows, solve_positive


class Cones(NamedTuple):
    """The contacts of p patches of s points on n degrees of freedom."""

    normal: Array
    """Speed along the normal by velocity, [p, s, n]."""
    stiff: Array
    """Normal force per acceleration, [p, s]."""
    push: Array
    """Normal force without acceleration, N, [p, s]."""
    along: Array
    """Speed in two directions along the surface, and about the normal times the patch's radius, by velocity,
    [p, 3, n]."""
    rub: Array
    """Friction per acceleration, [p]."""
    pull: Array
    """Friction without acceleration, N, [p, 3]."""
    coefficient: Array
    """Friction coefficient, [p]."""


class Forces(NamedTuple):
    """The forces of p patches, and which of them press and slip."""

    normal: Array
    """N, [p, s]."""
    friction: Array
    """N, [p, 3]."""
    presses: Array
    """[p, s] bool"""
    slips: Array
    """[p] bool"""
    way: Array
    """Unit vector of friction, [p, 3]."""
    left: Array
    """Share of the friction that would stick, [p]."""


class Solution(NamedTuple):
    """Acceleration [n], forces of rows [r] and of patches, and Newton steps taken []."""

    acceleration: Array
    rows: Array
    forces: Forces
    steps: Array


def within_cone(cones: Cones, push: Array, pull: Array) -> Forces:
    """Return the forces in the friction cones that are nearest to normal forces [p, s] and friction [p, 3] that stick.

    Where friction slips it gives way by an unknown amount, and the normal forces grow with it. It is the root of a
    concave function, piecewise linear with a corner at each point: Newton's method from the far end never overshoots.
    """
    mu, stiff = cones.coefficient[:, None], cones.stiff
    size = jnp.sqrt(jnp.sum(pull * pull, -1))
    amount = size / cones.rub
    for _ in range(push.shape[1]):
        raised = push + mu * stiff * amount[:, None]
        presses = raised > 0
        excess = size - cones.rub * amount - mu[:, 0] * jnp.sum(jnp.where(presses, raised, 0.0), -1)
        slope = cones.rub + mu[:, 0] ** 2 * jnp.sum(jnp.where(presses, stiff, 0.0), -1)
        amount = jnp.maximum(amount + excess / slope, 0.0)
    raised = push + mu * stiff * amount[:, None]
    left = jnp.where((raised > 0).any(-1), jnp.maximum(size - cones.rub * amount, 0.0), 0.0)
    way = pull / jnp.maximum(size, 1e-20)[:, None]
    return Forces(
        jnp.maximum(raised, 0.0), left[:, None] * way, raised > 0, amount > 0, way, left / jnp.maximum(size, 1e-20)
    )


def solve_contacts(
    mass: Array, smooth: Array, rows: Rows, cones: Cones, start: Array, iterations: int, line_search: int
) -> Solution:
    """Return the acceleration [n] at which inertia, the forces `smooth` [n], rows and contacts balance.

    Args:
        mass: mass matrix [n, n], with the implicit parts of other forces.
        smooth: sum of all other forces, [n].
        rows: friction and limits of joints, and contacts without friction.
        cones: contacts with friction.
        start: where to begin, [n].
        iterations: Newton steps at most.
        line_search: steps along each of them.
    """

    def sticking(x: Array) -> tuple[Array, Array, Array]:
        return (
            rows.impedance * (rows.reference - rows.jacobian @ x),
            cones.push - cones.stiff * (cones.normal @ x),
            cones.pull - cones.rub[:, None] * (cones.along @ x),
        )

    def newton(x: Array) -> tuple[Array, Array]:
        row, push, pull = sticking(x)
        force, forces = jnp.clip(row, rows.low, rows.high), within_cone(cones, push, pull)
        rest = mass @ x - smooth
        excess = rows.jacobian.T @ force - rest
        excess += jnp.einsum("ps,psn->n", forces.normal, cones.normal)
        excess += jnp.einsum("pi,pin->n", forces.friction, cones.along)
        gives = jnp.where((row > rows.low) & (row < rows.high), rows.impedance, 0.0)
        hessian = mass + rows.jacobian.T @ (gives[:, None] * rows.jacobian) + _hessian(cones, forces)
        search = solve_positive(hessian, excess)
        falls = rows.impedance * (rows.jacobian @ search)
        moves = cones.normal @ search, cones.along @ search
        row_speed, slope_0, slope_1 = rows.jacobian @ search, search @ rest, search @ (mass @ search)

        def look(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
            step, low, high = state
            there = row - step * falls
            felt = within_cone(cones, push - step * cones.stiff * moves[0], pull - step * cones.rub[:, None] * moves[1])
            slope = slope_0 + step * slope_1 - row_speed @ jnp.clip(there, rows.low, rows.high)
            slope -= jnp.sum(felt.normal * moves[0]) + jnp.sum(felt.friction * moves[1])
            growth = slope_1 + row_speed @ jnp.where((there > rows.low) & (there < rows.high), falls, 0.0)
            growth += jnp.sum(_growth(cones, felt, *moves))
            low, high = jnp.where(slope < 0, step, low), jnp.where(slope < 0, high, step)
            step = step - slope / jnp.maximum(growth, 1e-20)
            inside = jnp.where(slope < 0, step < high, step > low)  # as in `solver.py`
            return (jnp.where(inside, step, jnp.where(high < jnp.inf, (low + high) / 2, 2 * low)), low, high), None

        begin = (jnp.float32(1.0), jnp.float32(0.0), jnp.float32(jnp.inf))
        (step, _, _), _ = jax.lax.scan(look, begin, None, length=line_search, unroll=True)
        there, pushed, pulled = (
            row - step * falls,
            push - step * cones.stiff * moves[0],
            pull - step * cones.rub[:, None] * moves[1],
        )
        after = within_cone(cones, pushed, pulled)
        same = (((there > rows.low) == (row > rows.low)) & ((there < rows.high) == (row < rows.high))).all()
        same &= (after.presses == forces.presses).all() & (after.slips == forces.slips).all()
        turned = jnp.sum((after.friction - forces.friction) ** 2, -1) <= TOLERANCE**2 * jnp.sum(after.normal, -1) ** 2
        return x + step * search, same & (turned | ~after.slips).all()

    def going(state: tuple[Array, Array, Array]) -> Array:
        _, settled, count = state
        return ~settled & (count < iterations)

    def iterate(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, _, count = state
        x, settled = newton(x)
        return x, settled, count + 1

    x, _, count = jax.lax.while_loop(going, iterate, (start, jnp.bool_(False), jnp.int32(0)))
    row, push, pull = sticking(x)
    return Solution(x, jnp.clip(row, rows.low, rows.high), within_cone(cones, push, pull), count)


TOLERANCE = 1e-2
"""Change of friction in a Newton step, as a share of the normal force, at which sliding contacts have converged."""


def _weights(cones: Cones, forces: Forces) -> tuple[Array, Array, Array]:
    """Return the stiffness [p, s] of points that press, of friction [p], and of what slips against both [p]."""
    pressed = jnp.where(forces.presses, cones.stiff, 0.0)
    rub = jnp.where(forces.presses.any(-1), cones.rub, 0.0)
    return pressed, rub, jnp.where(forces.slips, 1 / (cones.rub + cones.coefficient**2 * jnp.sum(pressed, -1)), 0.0)


def _hessian(cones: Cones, forces: Forces) -> Array:
    """Return the stiffness of all patches by acceleration, [n, n]."""
    pressed, rub, soft = _weights(cones, forces)
    ahead = forces.way[:, :, None] * forces.way[:, None, :]
    grown = cones.coefficient**2 * jnp.sum(pressed, -1)
    along = jnp.where(forces.slips, grown * soft, 1.0)
    across = jnp.where(forces.slips, forces.left, 1.0)
    turning = rub[:, None, None] * (across[:, None, None] * (jnp.eye(3) - ahead) + along[:, None, None] * ahead)
    stiff = jnp.einsum("psn,ps,psm->nm", cones.normal, pressed, cones.normal)
    stiff += jnp.einsum("pin,pij,pjm->nm", cones.along, turning, cones.along)
    raised = jnp.einsum("p,ps,psn->pn", cones.coefficient, pressed, cones.normal)
    rubbed = rub[:, None] * jnp.einsum("pi,pin->pn", forces.way, cones.along)
    mixed = jnp.einsum("pn,p,pm->nm", raised, soft, rubbed - raised / 2)
    return stiff + mixed + mixed.T


def _growth(cones: Cones, forces: Forces, normal: Array, along: Array) -> Array:
    """Return the stiffness of each patch [p] along accelerations of its points [p, s] and its surface [p, 3]."""
    pressed, rub, soft = _weights(cones, forces)
    ahead = jnp.sum(forces.way * along, -1)
    square = jnp.sum(along * along, -1)
    grown = cones.coefficient**2 * jnp.sum(pressed, -1)
    raised, rubbed = cones.coefficient * jnp.sum(pressed * normal, -1), rub * ahead
    slides = rub * forces.left * (square - ahead**2) + soft * (grown * rub * ahead**2 + raised * (2 * rubbed - raised))
    return jnp.sum(pressed * normal**2, -1) + jnp.where(forces.slips, slides, rub * square)
