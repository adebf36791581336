"""Random grasps of objects: how many are dropped, how far objects slip and how deep jaws go in.

One arm moves at random at full speed. Two arms that hold one object pull and turn at random against each other.

Run: python -m docs.studies.grasping --grasps 1000 --seconds 10 --arms 1
"""

from __future__ import annotations

import json
import sys
from itertools import product
from typing import NamedTuple

import jax
import numpy as np

from docs.studies.command import make_parser, run
from docs.studies.plain_mujoco import play_in_jaws
from docs.studies.shaking import CHUNK, CLOSING, OBJECTS, Grasps, Seen
from surgical_marl.cli.flags import whole

SLIP, TURN = 2e-4, np.radians(1.0)
"""An object that has moved or turned further than this in a jaw has slipped, m and rad."""
LOST = 2e-3
"""An object that has moved this far in a jaw counts as dropped, m."""
CLOSED = CLOSING * CHUNK - 1
"""Control step at whose end the jaws have closed."""
BATCH = 250
"""Grasps that are drawn with one seed."""
COLUMNS = {
    "object": "object",
    "arms": "arms",
    "grasps": "grasps",
    "struck": "struck",
    "dropped": "dropped, of these struck",
    "dropped_in_mujoco": "of these dropped by C MuJoCo",
    "slipped": "slipped",
    "slipped_in_mujoco": "of these slipped in C MuJoCo",
    "slip_mm": "slip: 95 %, worst (mm)",
    "turn_deg": "turn: 95 %, worst (degrees)",
    "turn_in_mujoco_deg": "turn of those in C MuJoCo: worst (degrees)",
    "overlap_mm": "deepest overlap (mm)",
}
"""Names of figures, and headings of the table. Those of C MuJoCo are there if it played."""


class Moved(NamedTuple):
    """How objects moved in the jaws in which they moved most, once these had closed, [grasps] each."""

    far: np.ndarray
    """At most, m."""
    slip: np.ndarray
    """From rest to rest, m."""
    turn: np.ndarray
    """How far they turned from rest to rest, rad."""

    @property
    def lost(self) -> np.ndarray:
        """True if they moved so far that they count as dropped, bool."""
        return ~(self.far < LOST)

    @property
    def slipped(self) -> np.ndarray:
        """True if they slipped, bool."""
        return (self.slip > SLIP) | (self.turn > TURN)


class Held(NamedTuple):
    """How grasps held, [grasps] each."""

    moved: Moved
    moved_in_mujoco: Moved
    """NaN where C MuJoCo did not play."""
    overlap: np.ndarray
    """The deepest overlap with fingers once the jaws have closed, m."""
    dropped: np.ndarray
    """bool"""
    struck: np.ndarray
    """True if the wrist of an arm struck the object, bool: then it may well slip."""

    @property
    def slipped(self) -> np.ndarray:
        """True if objects slipped that were neither dropped nor struck, bool."""
        return self.moved.slipped & ~self.dropped & ~self.struck


def moves(position: np.ndarray, rotation: np.ndarray) -> Moved:
    """Return how objects moved in jaws: positions [E, steps, a, 3] and axes [E, steps, a, 3, 3] in their frames."""
    far = np.linalg.norm(position[:, CLOSED:] - position[:, CLOSED, None], axis=-1)
    return Moved(far.max((1, 2)), far[:, -1].max(-1), angle(rotation[:, CLOSED], rotation[:, -1]).max(-1))


def angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return by how much axes [..., 3, 3] are turned from others, rad, [...]."""
    trace = np.einsum("...ij,...ij->...", one.astype(float), other)
    found: np.ndarray = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return found


def judge(seen: Seen) -> Held:
    """Return how grasps [E] held in motions [E, steps] as `Grasps.shake` and `Grasps.pull` make them."""
    moved = moves(seen.position, seen.rotation)
    dropped = moved.lost | ~(seen.force[:, -1] > 0).all((1, 2))
    unknown = Moved(*np.full((len(moved), len(dropped)), np.nan))
    return Held(moved, unknown, seen.overlap[:, CLOSED:].max(1), dropped, seen.struck[:, CLOSED:].any(1))


def hold(
    name: str, arms: int, count: int, seconds: float, first: int = 0, share: float = 1.0, mujoco: bool = False,
    struck: bool = False,
) -> Held:  # fmt: skip
    """Return how `count` random grasps of an object hold.

    `share` is that of `Grasps.pull`, and `struck` that of `Grasps`. With `mujoco` C MuJoCo plays the grasps that
    dropped it or let it slip, too.
    """
    parts, jaws, size = [], Grasps([name], arms, struck), min(BATCH, count)
    held = np.zeros(size, int)
    for seed in range(first, first - (-count // size)):
        begin = jaws.begin(held, seed)
        seen = jaws.shake(begin, held, seconds, seed) if arms == 1 else jaws.pull(begin, held, seconds, seed, share)
        parts.append(judge(seen))
        which = np.flatnonzero(parts[-1].dropped | parts[-1].slipped)
        if mujoco and which.size:
            start = jax.tree.map(lambda x, which=which: np.asarray(x)[which], begin)
            found = moves(*play_in_jaws(jaws, start, seen.command[which], held[which]))
            for values, those in zip(parts[-1].moved_in_mujoco, found, strict=True):
                values[which] = those
    whole: Held = jax.tree.map(lambda *values: np.concatenate(values)[:count], *parts)
    return whole


def figures(name: str, arms: int, held: Held, mujoco: bool = False) -> dict[str, object]:
    """Return the figures of an object, with those of C MuJoCo if it played what was dropped or slipped.

    Slips and turns are those of grasps that were neither dropped nor struck.

    Raises:
        ValueError: there is no such grasp.
    """
    kept, theirs = ~held.struck & ~held.dropped, held.moved_in_mujoco
    if not kept.any():
        raise ValueError(f"no grasp of {name} holds it: all {len(kept)} drop it, or strike it with the wrist")

    def spread(values: np.ndarray, digits: int) -> list[float]:
        return [round(float(np.quantile(values[kept], q)), digits) for q in (0.95, 1.0)]

    found: dict[str, object] = {
        "object": name,
        "arms": arms,
        "grasps": len(kept),
        "struck": int(held.struck.sum()),
        "dropped": [int(held.dropped.sum()), int((held.dropped & held.struck).sum())],
        "dropped_in_mujoco": int((held.dropped & theirs.lost).sum()),
        "slipped": int(held.slipped.sum()),
        "slipped_in_mujoco": int((held.slipped & theirs.slipped).sum()),
        "slip_mm": spread(1000 * held.moved.slip, 4),
        "turn_deg": spread(np.degrees(held.moved.turn), 3),
        "turn_in_mujoco_deg": round(float(np.degrees(theirs.turn[held.slipped]).max(initial=0.0)), 3),
        "overlap_mm": round(1000 * float(held.overlap.max()), 4),
    }
    return {key: value for key, value in found.items() if mujoco or "in_mujoco" not in key}


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--arms", nargs="+", type=whole(1, 2), default=[1, 2], metavar="A", help="1, 2 or both (both)")
    parser.add_argument("--grasps", type=whole(1), default=100, metavar="N", help="of each object (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="T", help="of motion (%(default)s)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="S", help=f"of the first {BATCH} (%(default)s)")
    parser.add_argument("--share", type=float, default=1.0, metavar="X", help="of the way that two arms pull (1)")
    parser.add_argument(
        "--mujoco", action="store_true", help="let C MuJoCo play what is dropped or slips, at a tenth of the step"
    )
    parser.add_argument(
        "--struck", action="store_true", help="let one arm also grasp an object where its own wrist can strike it"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    arguments = parser.parse_args(argv)
    count, seconds, mujoco = arguments.grasps, arguments.seconds, arguments.mujoco
    for number, (arms, name) in enumerate(product(arguments.arms, arguments.objects)):
        held = hold(name, arms, count, seconds, arguments.seed, arguments.share, mujoco, arguments.struck)
        found = figures(name, arms, held, mujoco)
        if not arguments.json and number == 0:
            print(f"| {' | '.join(COLUMNS[key] for key in found)} |\n|{'---|' * len(found)}")
        cells = (", ".join(map(str, value)) if isinstance(value, list) else str(value) for value in found.values())
        print(json.dumps(found) if arguments.json else f"| {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run("grasping", main))
