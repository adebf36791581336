"""An eyelet and the end of a loose thread: where they are, and how much of the thread is through the hole.

eyelet = Eyelet(scene, "psm_0", "psm_1", "thread_ring")
turns, length = eyelet.through(nodes)          # nodes [n, 3] of the thread, in the world, m
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jax, jnp

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene

EYE = "eye"
"""The site in the middle of an eyelet's hole, whose z axis is that of the hole."""
BETWEEN = np.array([[-0.0024, -0.0006, -0.0090], [0.0024, 0.0006, 0.0004]], np.float32)
"""Box in a tool's frame in which a place of the thread is between the plates of a closed jaw, m."""


class Eyelet:
    """The hole of the first eyelet of a scene, and the scene's first loose thread, whose last node is its end.

    Args:
        scene: arms, eyelet and thread.
        first: the arm that brings the thread; the hole's axis points away from it.
        second: the arm that takes it.
        task: the name of the task, for the message.
        meant: scenes that have all of it, likewise.

    Raises:
        ValueError: the scene has no such eyelet or thread.
    """

    def __init__(self, scene: Scene, first: str, second: str, task: str, meant: Sequence[str] = ()) -> None:
        choices = f" (choose from {', '.join(meant)}, or a file)"
        holes = [place for place in scene.objects.values() if not place.object.free and EYE in place.object.sites]
        if not holes:
            raise ValueError(
                f"{label(task)} needs a scene with a fixed object that has the site {EYE}; {scene.name!r} has "
                f"none{choices}"
            )
        loose = [name for name, one in scene.systems.items() if hasattr(one, "rod") and not one.ties]
        if not loose:
            raise ValueError(
                f"{label(task)} needs a scene with a thread that is not tied; {scene.name!r} has none{choices}"
            )
        position, axes = holes[0].object.sites[EYE]
        self.centre: np.ndarray = holes[0].position + holes[0].rotation @ position
        """Middle of the hole, world, m, [3]."""
        axis = holes[0].rotation @ axes[:, 2]
        away = scene.mounts[second].position - scene.mounts[first].position
        self.axis: np.ndarray = axis if axis @ away > 0 else -axis
        """Direction from the first arm's side to the second's, [3]."""
        self.radius = min(_distance(shape, position, axes[:, 2]) for shape in holes[0].object.shapes)
        """Distance of the ring's own middle line from the axis of the hole, m."""
        self.thread = loose[0]
        """Name of the thread."""
        system: Any = scene.systems[self.thread]
        self.edge = float(system.rod.length)
        """Length of an edge of the thread, m."""
        self.path: np.ndarray = np.array(system.path, float)
        """Places of its nodes in the scene, m, [n, 3]."""
        self.behind: np.ndarray = self.edge * np.arange(len(self.path) - 1, -1, -1, dtype=np.float32)
        """Lengths between its nodes and its end, m, [n]."""

    def through(self, nodes: Any) -> tuple[Array, Array]:
        """Return how often a thread winds through the hole, and the length of its end that is past it.

        Args:
            nodes: of the thread in the world, m, [n, 3].

        Returns:
            Crossings of the hole's disc towards the second arm's side, less those back, [] int32; and the length from
            the last crossing to the thread's end, m, [], 0 where there is none.
        """
        centre, axis = self.centre.astype(np.float32), self.axis.astype(np.float32)

        def cross(found: tuple[Array, Array], edge: tuple[Any, Array, Array]) -> tuple[tuple[Array, Array], None]:
            (turns, length), (behind, start, end) = found, edge
            off, way = start - centre, end - start
            before, after = off @ axis, (end - centre) @ axis
            crosses = (before <= 0) != (after <= 0)
            share = before / jnp.where(crosses, before - after, 1.0)
            at = off + share * way
            crosses &= at @ at < np.float32(self.radius**2)
            turns += jnp.where(crosses, jnp.where(after > 0, 1, -1), 0)
            return (turns, jnp.where(crosses, behind - share * np.float32(self.edge), length)), None

        none = jnp.int32(0), jnp.float32(0.0)
        found: tuple[Array, Array] = jax.lax.scan(cross, none, (self.behind[:-1], nodes[:-1], nodes[1:]))[0]
        return found

    def pinched(self, nodes: Any, tip: Array, axes: Array) -> Array:
        """Return how far behind its end the foremost place of a thread is that a closed jaw holds, m, []; -1 for none.

        Args:
            nodes: of the thread in the world, m, [n, 3].
            tip: place of the tool tip in the world, m, [3].
            axes: of the tool's frame, columns, [3, 3].
        """

        def look(found: Array, edge: tuple[Any, Array, Array]) -> tuple[Array, None]:
            behind, start, end = edge
            for share in (0.0, 0.5):
                own = (start + np.float32(share) * (end - start) - tip) @ axes
                held = ((own > BETWEEN[0]) & (own < BETWEEN[1])).all()
                found = jnp.where(held, behind - np.float32(share * self.edge), found)
            return found, None

        found: Array = jax.lax.scan(look, jnp.float32(-1.0), (self.behind[:-1], nodes[:-1], nodes[1:]))[0]
        return found

    def place(self, nodes: Any, behind: float) -> Any:
        """Return the place on a thread that is a length behind its end, m, [3], from its nodes [n, 3]."""
        number, share = divmod(behind / self.edge, 1.0)
        last = len(self.path) - 1 - int(number)
        return nodes[last] + np.float32(share) * (nodes[max(last - 1, 0)] - nodes[last])

    def laid(self, shift: Any, turn: Any) -> Any:
        """Return the nodes of the thread as it lies shifted by [2], m, and turned about its end, rad, [n, 3]."""
        end, off = self.path[-1].astype(np.float32), (self.path - self.path[-1]).astype(np.float32)
        cos, sin, zero = jnp.cos(turn), jnp.sin(turn), jnp.float32(0.0)
        x, y = off[:, 0] * cos - off[:, 1] * sin, off[:, 0] * sin + off[:, 1] * cos
        return end + jnp.append(shift, zero) + jnp.stack([x, y, off[:, 2]], -1)


def _distance(shape: Any, point: np.ndarray, axis: np.ndarray) -> float:
    """Return the distance of the middle of a capsule from a line, m; inf for other shapes."""
    off = shape.position - point
    beside = off - off @ axis * axis
    return float(np.linalg.norm(beside)) if shape.kind == "capsule" else np.inf
