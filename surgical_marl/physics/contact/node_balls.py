"""Balls on the nodes of a mesh, as the shapes of a system; on a GPU a block of threads finds what they touch.

    balls = NodeBalls(position, velocity, points, inset=0.1, radius=0.0005)
    shapes = balls.shapes()

Functions of JAX are the reference, and `node_balls.cu` is the same in CUDA.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.engines.stages import MOST_SHARED, block_stage
from surgical_marl.physics.systems.brick_grid import SurfacePoints
from surgical_marl.physics.systems.system import Clusters, Ends, Shapes

THREADS = 128
"""Of a block."""


class NodeBalls(NamedTuple):
    """Balls at points of a mesh's surface, of n nodes. They lie under it."""

    position: Array
    """Of the nodes, world, m, [n, 3]."""
    velocity: Array
    """m/s, [n, 3]"""
    points: SurfacePoints
    """p points."""
    inset: float
    """Depth of their centres, as a share of the way to the node under each of theirs."""
    radius: float
    """m"""

    def shapes(self) -> Shapes:
        """Return the balls, with a cluster for each face of the mesh."""
        (position, velocity, points, inset, radius), count = self, len(self.points.inward)
        nodes, weights, inward = (jnp.asarray(x) for x in points[:3])

        def under(node: Array, inward: Array) -> Array:
            return (1 - inset) * position[node] + inset * position[node + inward]

        def part(number: Array) -> tuple[Array, Array]:
            own, share = nodes[number], weights[number]
            moves = share @ velocity[own]
            return share @ under(own, inward[number]), jnp.sqrt(moves @ moves)

        def around(face: Any) -> tuple[Array, Array]:
            own, inward = face
            corners = under(own, inward)
            centre = jnp.sum(corners, 0) / 4
            off = corners - centre
            return centre, jnp.sqrt(jnp.max(jnp.sum(off * off, 1))) + radius

        def faster(most: Array, v: Array) -> tuple[Array, None]:
            return jnp.maximum(most, v @ v), None

        fastest, _ = jax.lax.scan(faster, jnp.float32(0.0), velocity)
        centre, reach = jax.lax.map(around, (jnp.asarray(points.faces), inward[points.first[:-1]]))
        clusters = Clusters(centre, reach, points.first, jnp.sqrt(fastest), part, self)
        centre, speed = jax.lax.map(part, jnp.arange(count, dtype=jnp.int32))
        return Shapes(centre, centre, np.full(count, radius, np.float32), speed, clusters)


class Constants(NamedTuple):
    """The constants that the kernel reads."""

    nodes: np.ndarray
    """Of each point, [p, 4]."""
    weights: np.ndarray
    """Shares of the nodes, [p, 4]."""
    inward: np.ndarray
    """Difference of the numbers of the node under it and of the node itself, [p]."""
    face: np.ndarray
    """Number of the face of each point, [p]."""
    corners: np.ndarray
    """Nodes of each face, [f, 4]."""
    under: np.ndarray
    """Difference of the numbers of the nodes under them and of these, [f]."""
    stiffness: np.ndarray
    """Of the contact with each shape of others, N/m, [r]."""
    sliding: np.ndarray
    """Coefficient of friction with each, [r]."""


def found_by_block(
    find: Callable[[Any, Shapes, Any], Ends],
    scenery: Any,
    balls: NodeBalls,
    surfaces: tuple[np.ndarray, np.ndarray],
    numbers: Mapping[str, float],
    dt: Any,
) -> Ends:
    """Return the contacts of balls with all shapes of others, as `find` does, on a GPU by a block of threads.

    Args:
        find: takes the scenery, the balls as shapes and the duration of a step; returns the contacts.
        scenery: `Scenery` with plates and capsules.
        balls: the shapes of the system.
        surfaces: stiffness, N/m, and friction of the contact with each shape of others.
        numbers: constants of the kernel: whole ones are int.
        dt: duration of a step, s.
    """
    points = balls.points
    face = np.repeat(np.arange(len(points.faces), dtype=np.int32), np.diff(points.first))
    under = points.inward[points.first[:-1]]
    constants = Constants(*points[:3], face, points.faces, under, *surfaces)
    wholes = {"NODES": len(balls.position), "BALLS": len(face), "FACES": len(under)}
    wholes |= {name: x for name, x in numbers.items() if isinstance(x, int)}
    reals = {"INSET": balls.inset, "RADIUS": balls.radius}
    reals |= {name: x for name, x in numbers.items() if isinstance(x, float)}

    def contacts(scenery: Any, position: Array, velocity: Array, constants: Any, dt: Array) -> Ends:
        del constants  # for the kernel
        shapes = balls._replace(position=position, velocity=velocity).shapes()
        assert shapes.clusters
        return find(scenery, shapes._replace(clusters=shapes.clusters._replace(nodes=None)), dt)

    numbered = sum(wholes[name] * size for name, size in (("NODES", 24), ("BALLS", 17), ("FACES", 20)))
    shared = numbered + wholes["SHAPES"] * (45 + len(under)) + 45 * wholes["NEAREST"] + 8 * THREADS
    if shared > MOST_SHARED:
        return contacts(scenery, balls.position, balls.velocity, constants, dt)
    parts = [
        f"enum {{ {', '.join(f'{name} = {x}' for name, x in wholes.items())} }};",
        f"constexpr float {', '.join(f'{name} = {np.float32(x):.9e}f' for name, x in reals.items())};",
        Path(__file__).with_suffix(".cu").read_text(encoding="utf-8"),
    ]
    stage = block_stage(contacts, "\n".join(parts), THREADS, "node_balls")
    return stage(scenery, balls.position, balls.velocity, constants, jnp.float32(dt))
