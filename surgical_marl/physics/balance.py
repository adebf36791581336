"""The ways of arms that are joined, at which all forces balance: Newton's method on friction and limits of joints.

Contacts are linear functions here. So how the forces on all arms fall with their accelerations is one matrix M, and a
Newton step x solves (M + diag(g)) @ x = e: e are the forces that are left over, and g is by how much friction and
limits fall with the acceleration of each joint. Then M @ x is e - g * x, so no product with M is ever computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.search import search
from surgical_marl.physics.solver import JointRows, giving, rows_of, unbounded_forces


class Own(NamedTuple):
    """What belongs to each of a arms with m joints each at most."""

    force: Array
    """All forces at `start`, but for friction and limits of joints, [a, m]."""
    joints: JointRows
    """Friction and limits of joints, [a, m]."""
    start: Array
    """The acceleration that it begins with, [a, m]."""


class _State(NamedTuple):
    ways: Array
    """[a, m]"""
    spread: Array
    """M @ ways, [a, m]."""
    settled: Array
    steps: Array


def balanced(
    own: Own,
    step_of: Callable[[Array, Array], Array],
    resisted: Callable[[Array, Array, Array], tuple[Array, Array]],
    iterations: int,
) -> Array:
    """Return the ways [a, m], by at most `iterations` Newton steps: the last one is whole and changes no side.

    Args:
        own: what belongs to each arm.
        step_of: from g [a, m] and e [a, m] to the Newton step [a, m].
        resisted: from accelerations [a, m], ways [a, m] and a length to the slope of friction and limits of joints
            there, and by how much it grows per length.
        iterations: at least 1.
    """

    def left_over(row: Any) -> tuple[Array, Array]:
        own, way, spread = row
        rows = rows_of(own.joints)
        force = unbounded_forces(rows, own.start + way)
        held = rows.jacobian.T @ jnp.clip(force, rows.low, rows.high)
        return jnp.sum(giving(rows, force)[:, None] * rows.jacobian**2, 0), own.force + held - spread

    def look(sums: tuple[Array, Array, Array], row: Any) -> tuple[tuple[Array, Array, Array], Array]:
        own, way, gives, excess, step = row
        rows = rows_of(own.joints)
        force = unbounded_forces(rows, own.start + way)
        end = force - rows.impedance * (rows.jacobian @ step)
        kept = ((force > rows.low) == (end > rows.low)) & ((force < rows.high) == (end < rows.high))
        spread = excess - gives * step
        begin, growth, whole = sums
        return (begin - excess @ step, growth + step @ spread, whole & kept.all()), spread

    def newton(state: _State) -> _State:
        gives, excess = jax.lax.map(left_over, (own, state.ways, state.spread))
        steps = step_of(gives, excess)
        none = jnp.float32(0.0), jnp.float32(0.0), jnp.bool_(True)
        (begin, growth, whole), spread = jax.lax.scan(look, none, (own, state.ways, gives, excess, steps))

        def measure(length: Array, seen: Array) -> tuple[Array, Array, Array]:
            resists, yields = resisted(own.start + state.ways, steps, length)
            return jnp.sum((state.spread - own.force) * steps) + length * growth + resists, growth + yields, seen

        part = lambda: search(begin, 0.0, measure, jnp.float32(0.0)).length  # noqa: E731
        length = jax.lax.cond(whole, lambda: jnp.float32(1.0), part)
        return _State(state.ways + length * steps, state.spread + length * spread, whole, state.steps + 1)

    def unsettled(state: _State) -> Array:
        return ~state.settled & (state.steps < iterations)

    none = _State(jnp.zeros_like(own.start), jnp.zeros_like(own.start), jnp.bool_(False), jnp.int32(0))
    return jax.lax.while_loop(unsettled, newton, none).ways
