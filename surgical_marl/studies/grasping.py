"""Random grasps of objects: how many are dropped, how far objects slip and how deep jaws go in.

One arm moves at random at full speed. Two arms that hold one object pull and turn at random against each other.

Run: python -m surgical_marl.studies.grasping --grasps 1000 --seconds 10 --arms 1
"""

from __future__ import annotations

import json
import sys
from typing import NamedTuple

import jax
import numpy as np

from surgical_marl.cli.flags import whole
from surgical_marl.studies.command import make_parser, run
from surgical_marl.studies.plain_mujoco import play_in_jaws
from surgical_marl.studies.shaking import CHUNK, CLOSING, OBJECTS, Grasps, Seen

SLIP, TURN = 2e-4, np.radians(1.0)
"""An object that has moved or turned further than this in a jaw has slipped, m and rad."""
LOST = 2e-3
"""An object that has moved this far in a jaw counts as dropped, m."""
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
    "slip_mm": "slip: 95 %, worst (mm)",
    "turn_deg": "turn: 95 %, worst (degrees)",
    "overlap_mm": "deepest overlap (mm)",
}
"""Names of figures, and headings of the table."""


class Held(NamedTuple):
    """How grasps held, [grasps] each."""

    slip: np.ndarray
    """How far the object moved in the jaw in which it moved most, from rest to rest, m."""
    turn: np.ndarray
    """How far it turned, rad."""
    overlap: np.ndarray
    """The deepest overlap with fingers once the jaws have closed, m."""
    dropped: np.ndarray
    """bool"""
    struck: np.ndarray
    """Whether the wrist of an arm struck the object, bool: then it may well slip."""
    dropped_in_mujoco: np.ndarray
    """Whether the object was dropped, and C MuJoCo drops it too, bool: False unless that was asked."""


def judge(seen: Seen) -> Held:
    """Return how grasps [E] held in motions [E, steps] as `Grasps.shake` and `Grasps.pull` make them."""
    start = CLOSING * CHUNK - 1
    moved = np.linalg.norm(seen.position[:, start:] - seen.position[:, start, None], axis=-1)
    turned_by = np.einsum("eaij,eaij->ea", seen.rotation[:, start].astype(float), seen.rotation[:, -1]) - 1
    dropped = ~(moved.max((1, 2)) < LOST) | ~(seen.force[:, -1] > 0).all((1, 2))
    angle = np.arccos(np.clip(turned_by / 2, -1, 1)).max(-1)
    overlap, struck = seen.overlap[:, start:].max(1), seen.struck[:, start:].any(1)
    return Held(moved[:, -1].max(-1), angle, overlap, dropped, struck, np.zeros(len(dropped), bool))


def hold(
    name: str, arms: int, count: int, seconds: float, first: int = 0, share: float = 1.0, mujoco: bool = False
) -> Held:
    """Return how `count` random grasps of an object hold.

    `share` is that of `Grasps.pull`. With `mujoco` C MuJoCo plays the grasps that dropped it, too.
    """
    parts, jaws, size = [], Grasps([name], arms), min(BATCH, count)
    for seed in range(first, first - (-count // size)):
        held = np.zeros(size, int)
        seen = jaws.shake(held, seconds, seed) if arms == 1 else jaws.pull(held, seconds, seed, share)
        parts.append(judge(seen))
        if mujoco and (which := np.flatnonzero(parts[-1].dropped)).size:
            begin = jax.tree.map(lambda x, which=which: np.asarray(x)[which], jaws.begin(held, seed))
            place = play_in_jaws(jaws, begin, seen.command[which], held[which])[:, CLOSING * CHUNK - 1 :]
            far = np.linalg.norm(place - place[:, :1], axis=-1).max((1, 2))
            parts[-1].dropped_in_mujoco[which] = ~(far < LOST)
    return Held(*(np.concatenate(part)[:count] for part in zip(*parts, strict=True)))


def figures(name: str, arms: int, held: Held, mujoco: bool = False) -> dict[str, object]:
    """Return the figures of an object, with that of C MuJoCo if it played what was dropped.

    Slips and turns are those of grasps that were neither dropped nor struck.

    Raises:
        ValueError: there is no such grasp.
    """
    kept = ~held.struck & ~held.dropped
    if not kept.any():
        raise ValueError(f"no grasp of {name} holds it: all {len(kept)} drop it, or strike it with the wrist")
    spread = lambda values, digits: [round(float(np.quantile(values[kept], q)), digits) for q in (0.95, 1.0)]  # noqa: E731
    return {
        "object": name,
        "arms": arms,
        "grasps": len(kept),
        "struck": int(held.struck.sum()),
        "dropped": [int(held.dropped.sum()), int((held.dropped & held.struck).sum())],
        **({"dropped_in_mujoco": int(held.dropped_in_mujoco.sum())} if mujoco else {}),
        "slipped": int(((held.slip > SLIP) | (held.turn > TURN))[kept].sum()),
        "slip_mm": spread(1000 * held.slip, 4),
        "turn_deg": spread(np.degrees(held.turn), 3),
        "overlap_mm": round(1000 * float(held.overlap.max()), 4),
    }


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--arms", nargs="+", type=whole(1, 2), default=[1, 2], metavar="A", help="1, 2 or both (both)")
    parser.add_argument("--grasps", type=whole(1), default=100, metavar="N", help="of each object (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="T", help="of motion (%(default)s)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="S", help=f"of the first {BATCH} (%(default)s)")
    parser.add_argument("--share", type=float, default=1.0, metavar="X", help="of the way that two arms pull (1)")
    parser.add_argument(
        "--mujoco", action="store_true", help="let C MuJoCo play what is dropped, at a tenth of the step"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    arguments = parser.parse_args(argv)
    if not arguments.json:
        columns = [title for name, title in COLUMNS.items() if name != "dropped_in_mujoco" or arguments.mujoco]
        print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for arms in arguments.arms:
        for name in arguments.objects:
            held = hold(
                name, arms, arguments.grasps, arguments.seconds, arguments.seed, arguments.share, arguments.mujoco
            )
            found = figures(name, arms, held, arguments.mujoco)
            cells = (", ".join(map(str, value)) if isinstance(value, list) else str(value) for value in found.values())
            print(json.dumps(found) if arguments.json else f"| {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run("grasping", main))
