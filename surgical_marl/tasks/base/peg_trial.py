"""The rules of a trial with several blocks on a peg board: whose turn it is, points, and what ends it.

As in the challenge of ICRA 2026: all blocks start on the left, are handed over to the right one after the other, and
then back, again and again until the time is over. A block that is placed on its peg when it is its turn is a point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.runtime import jnp
from surgical_marl.tasks.base.blocks import upright

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.world import World

APART = 0.029
"""Least distance between the pegs of a side that blocks stand on in a trial, m: a finger fits between 30 mm, not 20."""
POOL = 256
"""Draws of how a block stands on a peg, of which those that the arms reach are kept."""


class Trial(NamedTuple):
    """What happened in a trial so far, [] each."""

    score: Array
    """Points, float32."""
    scored: Array
    """Time of the last one, s; 0 without any."""
    time: Array
    """Since the start, s."""
    fallen: Array
    """1 while the block whose turn it is lies where it was dropped, float32."""


class Turns:
    """Whose turn it is. A row of the tables is a turn of a trial: rows r n, ..., r n + n - 1 are those of trial r.

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
        """Return the number of the block whose turn it is."""
        return row % len(self.blocks)

    def back(self, row: Any) -> Any:
        """Return whether it goes back, from the second arm to the first."""
        return row % self.count >= len(self.blocks)

    def following(self, row: Any) -> Any:
        """Return the row of the next turn; the first one follows the last."""
        return row - row % self.count + (row + 1) % self.count

    def at_hand(self, world: World, name: str) -> World:
        """Return the world with the block whose turn it is under the name `name`, whichever one it is."""
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
        """Return what belongs to each agent with that of both arms exchanged where the block goes back."""
        back = self.back(row)
        changed = {
            picker: jnp.where(back, of[presenter], of[picker]),
            presenter: jnp.where(back, of[picker], of[presenter]),
        }
        return {**of, **changed}


def draw_trials(
    rng: np.random.Generator,
    count: int,
    blocks: int,
    sides: tuple[np.ndarray, np.ndarray],
    possible: tuple[Callable[[np.ndarray], np.ndarray], ...],
    shift: float,
    base: np.ndarray,
) -> np.ndarray:
    """Return where blocks stand on pegs of both sides in a number of trials, poses [count, 2, blocks, 4, 4].

    Args:
        rng: of the draws.
        count: how many trials.
        blocks: how many blocks.
        sides: pegs of each side, [n, 3].
        possible: for each side, whether blocks at poses [n, 4, 4] can be brought to the other one, [n] bool.
        shift: greatest distance of a block from the axis of its peg, m.
        base: middle of a block's underside in its frame, [3], m.

    Raises:
        ValueError: a side has too few pegs for so many blocks, or a peg is out of reach.
    """
    found = []
    for pegs, can in zip(sides, possible, strict=True):
        sets = np.array(_sets(pegs, blocks))
        pools = [_standing(rng, peg - base, shift, can) for peg in pegs] if len(sets) else []
        if not pools or not all(map(len, pools)):
            raise ValueError(f"a trial of {blocks} blocks needs as many pegs 30 mm apart on each side, all in reach")
        chosen = rng.permuted(sets[rng.integers(len(sets), size=count)], axis=1)
        found.append([[pools[peg][rng.integers(len(pools[peg]))] for peg in row] for row in chosen])
    return np.stack(found, 1)


def in_turn(poses: np.ndarray) -> np.ndarray:
    """Return where all blocks stand at the beginning of each turn, [count * 2 blocks, blocks, ...].

    Args:
        poses: of blocks on their pegs of both sides, [count, 2, blocks, ...], as `draw_trials` returns them.
    """
    blocks = poses.shape[2]
    turn, block = np.arange(2 * blocks)[:, None], np.arange(blocks)
    over = (block < turn) & (block >= turn - blocks)
    return np.asarray(poses[:, over.astype(int), block]).reshape(-1, *poses.shape[2:])


def _standing(rng: np.random.Generator, place: np.ndarray, shift: float, can: Callable[..., np.ndarray]) -> np.ndarray:
    away, bearing = shift * np.sqrt(rng.random(POOL)), rng.uniform(-np.pi, np.pi, POOL)
    places = place + np.stack([away * np.cos(bearing), away * np.sin(bearing), 0 * away], -1)
    poses = upright(places, rng.uniform(-180.0, 180.0, POOL))
    return poses[can(poses)]


def _sets(pegs: np.ndarray, count: int) -> list[tuple[int, ...]]:
    """Return the sets of so many pegs of a side that are all `APART`."""
    near = np.linalg.norm(pegs[:, None] - pegs, axis=-1) < APART
    return [some for some in combinations(range(len(pegs)), count) if near[np.ix_(some, some)].sum() == count]
