"""Where shapes touch: points, depths and normals are those of geometry, and change as little as the shapes move."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from surgical_marl.physics.contact.contact_patch import BLEND, TILT_IN_JAW, Patch, find_patch
from surgical_marl.physics.contact.shapes import NEAR, Plate, Points, Segments, between_segments, on_plate
from surgical_marl.physics.tree_utils import row_of

HALF, THICK, WIRE = np.array([0.0042, 0.0018]), 0.0006, 0.0005
"""A jaw's plate and a wire, m."""
CORNERS = np.array([[-0.006, -0.002, 0.0], [-0.002, 0.0, 0.0], [0.002, 0.0, 0.0], [0.006, -0.002, 0.0]])
"""A bent wire of three capsules, in its own frame, m."""
STEP = 1e-8
"""How far a pose is moved, m, and how far it is turned times the wire's half length."""
APART = 3e-4
"""Least distance of cores at which normals are looked at, m: where cores meet there is none."""
NOISE = 5e-9
"""Rounding of single precision, m."""


def numbers(size: float) -> st.SearchStrategy[float]:
    return st.floats(-size, size, allow_subnormal=False)


poses = st.tuples(numbers(0.006), numbers(0.006), st.floats(0.0008, 0.0015), numbers(3.0), numbers(0.2), numbers(0.2))
moves = st.tuples(*[numbers(1.0)] * 6)


def turned(about: jnp.ndarray) -> jnp.ndarray:
    """Return the rotation by a vector, rad: by the exponential."""
    x, y, z = about
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return jax.scipy.linalg.expm(cross)


def wire_at(pose: jnp.ndarray) -> Segments:
    """Return a wire turned about z, x and y, in that order, and moved."""
    eye = jnp.eye(3)
    turn = turned(pose[5] * eye[1]) @ turned(pose[4] * eye[0]) @ turned(pose[3] * eye[2])
    corners = pose[:3] + CORNERS @ turn.T
    return Segments(corners[:-1], corners[1:], jnp.full(3, WIRE))


PLATE = Plate(jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.asarray(HALF)[None], jnp.full(1, THICK))


@jax.jit
def touch(pose: jnp.ndarray) -> tuple[Points, Patch]:
    points = on_plate(wire_at(pose), PLATE)
    flat = Points(*(part.reshape(-1, *part.shape[2:]) for part in points))
    count, look = len(points.depth), lambda n: row_of((points, points.depth), n)
    middle, axes, torsion = points.place[0, 0], jnp.eye(3)[:2], jnp.float32(0.002)
    return flat, find_patch(look, count, count, middle, axes, TILT_IN_JAW, torsion)


@jax.jit
def cross(pose: jnp.ndarray) -> Points:
    one = wire_at(pose)
    return between_segments(one, Segments(jnp.zeros((1, 3)), jnp.array([[0.004, 0.001, 0.0]]), jnp.full(1, THICK)))


def small(pose: tuple[float, ...], move: tuple[float, ...]) -> np.ndarray:
    """Return a pose a little way off."""
    return np.array(pose) + STEP * np.array(move) / np.array([1, 1, 1, 0.006, 0.006, 0.006])


def moved(one: Points, other: Points) -> tuple[float, float, float]:
    """Return by how much depths, places and normals differ most."""
    norm = lambda x: float(jnp.max(jnp.linalg.norm(x, axis=-1)))  # noqa: E731
    return (float(jnp.max(jnp.abs(one.depth - other.depth))), norm(one.place - other.place),
            norm(one.normal - other.normal))  # fmt: skip


@given(poses, moves)
@settings(max_examples=300, deadline=None)
@example((0.0, 0.0018, 0.00105, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0, 0.0, 0.0))  # parallel to an edge, across it
@example((0.0, 0.0, 0.00105, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 1.0, 1.0))  # flat, then tilted
@example((0.0062, 0.0, 0.00105, 1.5, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0))  # leaves over the short edge
def test_contact_with_a_plate_is_a_continuous_function_of_the_pose(
    pose: tuple[float, ...], move: tuple[float, ...]
) -> None:
    """A small motion changes depths by no more than the motion, and places and normals by a bounded factor."""
    (here, patch), (there, other) = touch(jnp.array(pose)), touch(jnp.asarray(small(pose, move)))
    assume(float(here.depth.max()) < THICK + WIRE - APART)
    way = 6 * STEP + NOISE  # three directions and three angles
    depth, place, normal = moved(here, there)
    assert depth <= way and place <= 2 / NEAR * way and normal <= 2 / NEAR * way / APART
    depth, place, normal = moved(patch.points, other.points)
    most = 4 * 0.012 / BLEND  # as it goes from one end of the wire to the other
    assert depth <= 5 * way and place <= most * way and normal <= (most * NEAR + 2 / NEAR) * way / APART
    assert abs(float(patch.radius - other.radius)) <= most * way


@given(poses, moves)
@settings(max_examples=100, deadline=None)
@example((0.001, 0.0005, 0.00105, 0.2449787, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))  # parallel
def test_contact_of_capsules_is_a_continuous_function_of_the_pose(
    pose: tuple[float, ...], move: tuple[float, ...]
) -> None:
    here, there = cross(jnp.array(pose)), cross(jnp.asarray(small(pose, move)))
    assume(float(here.depth.max()) < THICK + WIRE - APART)
    depth, place, normal = moved(here, there)
    way = 6 * STEP + NOISE
    assert depth <= 2 * way and place <= 4 / NEAR * way and normal <= 4 / NEAR * way / APART


@given(poses)
@settings(max_examples=50, deadline=None)
def test_the_overlap_with_a_plate_is_that_of_geometry(pose: tuple[float, ...]) -> None:
    """Of 20,001 places along each capsule none is deeper than its nearest point by more than the price."""
    wire, (points, _) = wire_at(jnp.array(pose)), touch(jnp.array(pose))
    start, end, share = np.array(wire.start, float), np.array(wire.end, float), np.linspace(0, 1, 20001)[:, None]
    for c in range(3):
        along = start[c] + share * (end[c] - start[c])
        away = np.concatenate([along[:, :2] - np.clip(along[:, :2], -HALF, HALF), along[:, 2:]], 1)
        deepest = THICK + WIRE - np.linalg.norm(away, axis=1).min()
        assume(deepest < THICK + WIRE - APART)
        found = float(points.depth[3 * c : 3 * c + 3].max())
        price = NEAR / 2 * np.linalg.norm(end[c] - start[c]) * (THICK + WIRE) / APART
        assert -1e-7 <= deepest - found <= price
