"""The search along a line, and what it knows of contacts: the whole curvature, and random convex functions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.physics.contact.friction_cone import (
    Cone,
    Forces,
    Springs,
    Stuck,
    curvature,
    falls,
    nearest,
    parting,
    stretched,
    wrench,
)
from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.solver.newton import ENOUGH, line_search

POINTS = 4


def drawn(rng: np.random.Generator) -> tuple[Cone, Stuck]:
    """A contact that sticks, slips, presses or is apart, by chance."""
    single = lambda *shape: jnp.asarray(rng.standard_normal(shape), jnp.float32)  # noqa: E731
    stiff, rub = rng.uniform(0.1, 10, POINTS), rng.uniform(0.1, 10)
    normal, push, along, pull = single(POINTS, 6), 3 * single(POINTS), single(3, 6), 3 * single(3)
    springs = Springs(jnp.asarray(stiff, jnp.float32), jnp.float32(rub), jnp.float32(rng.uniform(0.1, 1)))
    return Cone(normal, along, springs), Stuck(push, pull)


@jax.jit
def forces(cone: Cone, stuck: Stuck, twist: jax.Array) -> Forces:
    return nearest(cone.springs, stretched(cone.springs, stuck, parting(cone, twist)))


@jax.jit
def along(cone: Cone, stuck: Stuck, at: jax.Array, way: jax.Array) -> tuple[jax.Array, jax.Array]:
    """How the forces of a patch fall along a way, as a wrench: by `falls`, and by the whole curvature."""
    felt = forces(cone, stuck, at)
    normal, friction = falls(cone.springs, felt, parting(cone, way))
    return normal @ cone.normal + friction @ cone.along, curvature(cone, felt)[packed(6)] @ way


def test_what_falls_along_a_way_is_the_curvature_there() -> None:
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(100):
        (cone, stuck), (at, way) = drawn(rng), jnp.asarray(rng.standard_normal((2, 6)), jnp.float32)
        one, other = along(cone, stuck, at, way)
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
        felt = forces(cone, stuck, at)
        seen.add((bool(felt.slips), bool((felt.normal > 0).any())))
        ahead, behind = (wrench(cone, forces(cone, stuck, at + sign * 1e-3 * way)) for sign in (1, -1))
        assert -float((ahead - behind) @ way) > -1e-3, "the cost is convex"
    assert seen == {(False, True), (True, True), (True, False)}


@settings(max_examples=25, deadline=None)
@given(
    begin=st.floats(1e-3, 1e3),
    corners=st.lists(st.tuples(st.floats(1e-3, 10.0), st.floats(1e-2, 1e4)), max_size=6),
    growth=st.floats(1e-1, 1e2),
)
def test_a_length_is_found_where_the_slope_is_small(
    begin: float, corners: list[tuple[float, float]], growth: float
) -> None:
    """Of a slope that grows with a corner here and there, as where points begin to press."""

    def measure(length: jax.Array) -> tuple[jax.Array, jax.Array]:
        slope, grows = begin * (growth * length - 1), begin * jnp.float32(growth)
        for place, more in corners:
            slope += begin * more * jnp.maximum(length - place, 0.0)
            grows += jnp.where(length > place, begin * more, 0.0)
        return slope, grows

    length = line_search(jnp.float32(-begin), 0.0, measure).length
    slope, _ = measure(length)
    assert 0 < float(length) <= 1 / growth * (1 + ENOUGH) + 1e-6
    assert abs(float(slope)) <= ENOUGH * begin


def test_a_slope_that_is_next_to_none_takes_the_whole_way_without_a_look() -> None:
    found = line_search(jnp.float32(-1e-3), 1e-3, lambda length: (length, length))
    assert (float(found.length), int(found.looks)) == (1.0, 0)


def test_a_slope_that_is_steep_between_flat_ends_does_not_send_the_search_to_and_fro() -> None:
    """Where friction of a block on a peg turns round on the way, Newton's steps lead from each end to the other one."""
    slopes = [-455.5, -409.1, -360.4, -305.4, -230.2, -86.2, 124.6, 243.0, 305.1, 351.3, 392.2]
    growths = [457.8, 471.3, 508.3, 611.4, 968.4, 2015.5, 1732.0, 789.1, 510.7, 427.4, 396.4]

    def measure(length: jax.Array) -> tuple[jax.Array, jax.Array]:
        places = jnp.linspace(0.0, 1.0, len(slopes))
        return jnp.interp(length, places, jnp.array(slopes)), jnp.interp(length, places, jnp.array(growths))

    found = line_search(jnp.float32(slopes[0]), 0.0, measure)
    slope, _ = measure(found.length)
    assert abs(float(slope)) <= -ENOUGH * slopes[0]
    assert int(found.looks) <= 4
