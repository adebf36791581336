"""Draw places of blocks at the start of an episode or a turn, and their goals: on the host, once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

from surgical_marl.tasks.base.workspace import choose
from surgical_marl.tasks.peg_transfer.blocks import as_numbers, upright
from surgical_marl.tasks.peg_transfer.script import Transfer
from surgical_marl.tasks.peg_transfer.trial import Turns

APART = 0.029
"""Least distance between the pegs of a side that blocks stand on in a trial, m: a finger fits between 30 mm, not 20."""
POOL = 256
"""Number of random poses of a block on a peg; poses that the arms reach are kept."""
Sides = tuple[np.ndarray, np.ndarray]
"""Pegs of the side that a block leaves, and of the one that it goes to, [n, 3] each, m."""


def draw_moves(
    way: Transfer, count: int, seed: int, sides: Sides, base: np.ndarray, shift: float, farthest: float
) -> np.ndarray:
    """Return starts and goals of one block that the arms can bring from one to the other, [count, 7 + 7].

    Args:
        way: how they bring it.
        count: how many.
        seed: of the draws.
        sides: its pegs.
        base: middle of the block's underside in its frame, [3], m.
        shift: greatest distance of the block from the axis of its peg at the start, m.
        farthest: greatest distance of the goal from the start, m.
    """
    rng, (from_pegs, to_pegs) = np.random.default_rng(seed), sides

    def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
        one, other = (pegs[rng.integers(len(pegs), size=count)] for pegs in (from_pegs, to_pegs))
        far = np.linalg.norm(one - other, axis=-1)
        good = (far > 0) & (far < farthest)
        off, yaw = shift * np.sqrt(rng.random(count)), rng.uniform(-180.0, 180.0, count)
        bearing = rng.uniform(-np.pi, np.pi, count)
        place = one - base + np.stack([off * np.cos(bearing), off * np.sin(bearing), 0 * yaw], -1)
        starts, goals = upright(place, yaw), upright(other - base, yaw)
        if way.giver != way.taker:
            good &= way.possible(starts)
        else:
            number = way.aligned(starts)
            good &= way.reaches(way.giver, starts, number) & way.reaches(way.giver, goals, number)
        rows = np.concatenate([as_numbers(starts), as_numbers(goals)], -1)[good]
        return rows, np.zeros(len(rows), bool)

    return choose(way.scene, batch, count, 0.0)


def draw_turns(
    ways: Sequence[Transfer], count: int, seed: int, sides: Sides, base: np.ndarray, shift: float
) -> np.ndarray:
    """Return where all blocks stand at the beginning of each turn of a number of trials, [count * turns, blocks * 7].

    Args:
        ways: how the arms bring each block over the wall, and then each of them back.
        count, seed, sides, base, shift: as of `draw_moves`.
    """
    blocks = len(ways) // 2
    possible = ways[0].possible, ways[blocks].possible
    poses = draw_trials(np.random.default_rng(seed), count, blocks, sides, possible, shift, base)
    return as_numbers(in_turn(poses)).reshape(-1, blocks * 7)


def goals_in_turn(places: np.ndarray, turns: Turns, pegs: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return where the block whose turn it is should be, in the middle of its peg, poses [rows, 4, 4].

    Args:
        places: of all blocks at the beginning of each turn, [rows, blocks, 7].
        turns: whose turn it is.
        pegs: all pegs of the board, [n, 3], m.
        base: middle of a block's underside in its frame, [3], m.
    """
    rows = np.arange(len(places))
    end = places[turns.following(rows), turns.number(rows), :3]
    nearest = np.linalg.norm(end[:, None, :2] - pegs[:, :2], axis=-1).argmin(1)
    return upright(pegs[nearest] - base, np.zeros(len(rows)))


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
