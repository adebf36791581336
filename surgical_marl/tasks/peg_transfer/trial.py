"""The rules of a trial with several blocks on a peg board: whose turn it is, points, and what ends it.

As in the challenge of ICRA 2026: all blocks start on the left, are handed over to the right one after the other, and
then back, again and again until the time is over. A block that is placed on its peg when it is its turn is a point.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from surgical_marl.runtime import jnp

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.world import World


class Trial(NamedTuple):
    """State of a trial so far, [] each."""

    score: Array
    """Points, float32."""
    scored: Array
    """Time of the last point, s; 0 without any."""
    time: Array
    """Time since the start, s."""
    fallen: Array
    """1 while the block in turn lies where it was dropped, else 0, float32."""


class Turns:
    """The turns of a trial. A row of the tables is a turn of a trial: rows r n, ..., r n + n - 1 are those of trial r.

    Args:
        scene: the arms and the blocks.
        block: the name of the first block. All objects of its kind take part, in the order of the scene.

    Attributes:
        blocks: their names.
        count: n, the turns until all have been there and back.
    """

    def __init__(self, scene: Scene, block: str) -> None:
        kind = scene.objects[block].object.name
        self.blocks = tuple(name for name, place in scene.free_objects.items() if place.object.name == kind)
        self.count = 2 * len(self.blocks)

    def number(self, row: Any) -> Any:
        """Return the number of the block in turn."""
        return row % len(self.blocks)

    def back(self, row: Any) -> Any:
        """Return whether the block in turn goes back, from the second arm to the first."""
        return row % self.count >= len(self.blocks)

    def following(self, row: Any) -> Any:
        """Return the row of the next turn; the first one follows the last."""
        return row - row % self.count + (row + 1) % self.count

    def at_hand(self, world: World, name: str) -> World:
        """Return the world in which the block in turn has the name `name`."""
        number = self.number(world.goal.row)

        def chosen(of: Mapping[str, Any]) -> Any:
            found = of[self.blocks[0]]
            for i, block in enumerate(self.blocks[1:], 1):
                parts = zip(of[block], found, strict=True)
                found = type(found)(*(jnp.where(number == i, other, one) for other, one in parts))
            return found

        arms = {
            agent: view._replace(handles={**view.handles, name: chosen(view.handles)})
            for agent, view in world.arms.items()
        }
        return world._replace(arms=arms, objects={**world.objects, name: chosen(world.objects)})

    def roles(self, row: Array, of: Mapping[str, Array], picker: str, presenter: str) -> dict[str, Array]:
        """Return values by agent, with those of `picker` and `presenter` exchanged where the block goes back."""
        back = self.back(row)
        changed = {
            picker: jnp.where(back, of[presenter], of[picker]),
            presenter: jnp.where(back, of[picker], of[presenter]),
        }
        return {**of, **changed}
