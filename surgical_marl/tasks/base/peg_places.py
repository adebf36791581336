"""Where blocks stand when an episode or a turn begins, and where they have to go: drawn on the host, once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgical_marl.tasks.base.blocks import as_numbers, upright
from surgical_marl.tasks.base.peg_script import Transfer
from surgical_marl.tasks.base.peg_trial import Turns, draw_trials, in_turn
from surgical_marl.tasks.base.workspace import choose

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
