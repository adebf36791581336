"""Random grasps of objects, shaken at full speed: how many are dropped, how far objects slip and how deep jaws go in.

Run: python -m surgical_marl.studies.grasping --grasps 1000 --seconds 10
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from surgical_marl import load_scene
from surgical_marl.cli.main import whole
from surgical_marl.physics.bodies import rotation
from surgical_marl.physics.collision import Pairs
from surgical_marl.physics.dynamics import Dynamics, Physics
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.together import Together
from surgical_marl.physics.views import Handled
from surgical_marl.robots.rotation import quaternion
from surgical_marl.scenes.grasps import Jaw
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import DECIMATION
from surgical_marl.studies.command import make_parser, run

OBJECTS = {"needle_sh": "grasp", "needle_40": "grasp", "block": "grasp_0"}
"""Objects, and the site at which each is grasped: its x axis is along the wire or bar."""
CONTROL = 0.02
CHUNK = 12
"""Control steps between two changes of direction, 0.24 s."""
CLOSING, RESTING = 3, 2
"""Chunks in which the jaw closes at the start, and in which the arm stands at the end."""
CLOSE = 2e-4
"""An object this near to another part of the arm counts as struck by it, m."""
LOST = 2e-3
"""An object that has moved this far in the jaw counts as dropped, m."""


class Seen(NamedTuple):
    """What is seen of the object at the end of control steps [...]."""

    position: Any
    """Centre of mass in the frame of the finger pair, m, [..., 3]."""
    rotation: Any
    """Axes likewise, [..., 3, 3]."""
    force: Any
    """Normal forces of the two fingers, N, [..., 2]."""
    overlap: Any
    """The deepest overlap with the fingers in all physics steps of the control step, m, [...]."""
    struck: Any
    """Whether another part of the arm was at the object in one of these steps, [...] bool."""
    holding: Any
    """Whether the arm holds it, [...]."""
    place: Any
    """Centre of mass in the world, m, [..., 3]."""
    command: Any
    """Commands of all actuators in each physics step, [..., DECIMATION, nu]."""


class Grasps:
    """One PSM that grasps one of some objects in the air, in environments side by side. All others fall.

    Args:
        objects: their names or files. One that isn't in `OBJECTS` has a site `grasp`.
    """

    def __init__(self, objects: Sequence[str]) -> None:
        self.scene = scene_of(objects)
        self.names = tuple(self.scene.objects)
        (self.agent,) = self.scene.agents
        self.simulator = Simulator(self.scene, decimation=1)
        self._dynamics = Dynamics(self.scene.model)
        self.together = Together(self.scene, self._dynamics, Pairs(self.scene.model))
        self._jaw = Jaw(self.scene, self.agent)
        self._play = jax.jit(jax.vmap(self._advance))

    def begin(self, held: np.ndarray, seed: int = 0) -> Physics:
        """Return states [E]: the arm anywhere, its jaw around the object without touching it.

        Args:
            held: number of the object that is between the pads, [E].
            seed: of the random numbers.
        """
        rng = np.random.default_rng(seed)
        drawn = zip(*(self._draw(rng, self.names[o]) for o in held), strict=True)
        qpos, position, turn = (jnp.asarray(np.array(part), jnp.float32) for part in drawn)
        physics, each = jax.vmap(self.simulator.at)(qpos), np.arange(len(held))
        bodies = physics.objects.bodies
        placed = bodies._replace(
            position=bodies.position.at[each, held].set(position),
            quaternion=bodies.quaternion.at[each, held].set(turn),
        )
        return physics._replace(objects=physics.objects._replace(bodies=placed))

    def play(self, physics: Physics, actions: np.ndarray, held: np.ndarray) -> tuple[Physics, Seen]:
        """Return states [E] after actions [E, steps, n], and what was seen of the held objects, [E, steps]."""
        physics, seen = self._play(physics, jnp.asarray(actions, jnp.float32), jnp.asarray(held))
        return physics, jax.tree.map(np.asarray, seen)

    def shake(self, held: np.ndarray, seconds: float, seed: int = 0) -> Seen:
        """Return what is seen [E, steps] of grasps that close, are shaken at full speed and stand still again."""
        rng, physics, seen = np.random.default_rng(seed + 1), self.begin(held, seed), []
        count, shaken = len(held), max(1, round(seconds / CONTROL / CHUNK))
        for chunk in range(CLOSING + shaken + RESTING):
            actions = np.zeros((count, CHUNK, len(self.scene.mounts[self.agent].arm.actuated)), np.float32)
            if CLOSING <= chunk < CLOSING + shaken:
                actions += rng.choice([-1.0, 1.0], (count, 1, actions.shape[-1]))
            actions[..., -1] = -1.0
            physics, found = self.play(physics, actions, held)
            seen.append(found)
        return Seen(*(np.concatenate(parts, 1) for parts in zip(*seen, strict=True)))

    def _advance(self, physics: Physics, actions: Any, held: Any) -> tuple[Physics, Seen]:
        # eight commands of an eighth of the way each are one of the whole
        def substep(physics: Physics, action: Any) -> tuple[Physics, Seen]:
            physics, _, views = self.simulator.advance(self.simulator.command(physics, {self.agent: action}))
            return physics, self._look(physics, views[self.agent].handles, held)

        physics, seen = jax.lax.scan(substep, physics, jnp.repeat(actions, DECIMATION, 0))
        deepest = seen.overlap.reshape(-1, DECIMATION).max(1)
        struck = seen.struck.reshape(-1, DECIMATION).any(1)
        last = Seen(*(part[DECIMATION - 1 :: DECIMATION] for part in seen))
        command = seen.command.reshape(-1, DECIMATION, seen.command.shape[-1])
        return physics, last._replace(overlap=deepest, struck=struck, command=command)

    def _look(self, physics: Physics, handles: Mapping[str, Handled], held: Any) -> Seen:
        data, bodies = self._dynamics.pose(physics.qpos), physics.objects.bodies
        tables = self.together.tables
        fingers = tables.bodies["pads"]
        along, down = (data.xmat[fingers][:, :, axis].sum(0) for axis in (1, 2))
        along, down = along / jnp.linalg.norm(along), down / jnp.linalg.norm(down)
        frame = jnp.stack([jnp.cross(along, down), along, down], 1)
        position = frame.T @ (bodies.position[held] - data.xpos[fingers].mean(0))
        turned_by = frame.T @ rotation(bodies.quaternion[held])
        holding = jnp.stack([handles[name].holding for name in self.names])[held]
        depth, grips = self.together.depths(physics), tables.finger < len(tables.fingers)
        overlap = jnp.max(jnp.where(grips, depth, -1.0))
        struck = jnp.max(jnp.where(grips | (tables.owner == tables.arms), -1.0, depth)) > -CLOSE
        force, place = physics.objects.grips.force[held], bodies.position[held]
        return Seen(position, turned_by, force, overlap, struck, holding, place, physics.ctrl)

    def _draw(self, rng: np.random.Generator, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return qpos, and the object's centre of mass and quaternion: between the pads, and not in the wrist's way."""
        item = self.scene.objects[name].object
        grasp = self._jaw.draw(name, item.sites[OBJECTS.get(name, "grasp")], rng)
        place = grasp.position + grasp.rotation @ item.center
        return self.scene.full_qpos({self.agent: grasp.q}), place, quaternion(grasp.rotation)


def scene_of(objects: Sequence[str]) -> Scene:
    """Return a scene of one PSM and some objects in the air, by their names or files."""
    places = [f"  {Path(o).stem}: {{object: {o}, position: [{0.1 * i}, 0.3, 0.0]}}" for i, o in enumerate(objects)]
    arm = ["arms:", "  psm_0: {arm: psm, position: [0.0, 0.0, 0.15]}"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "psm_in_the_air.yaml"
        path.write_text("\n".join([*arm, "objects:", *places]))
        return load_scene(path)


class Held(NamedTuple):
    """How grasps held, [grasps] each."""

    slip: np.ndarray
    """How far the object moved in the jaw, from rest to rest, m."""
    turn: np.ndarray
    """How far it turned, rad."""
    overlap: np.ndarray
    """The deepest overlap once the jaw has closed, m."""
    dropped: np.ndarray
    """bool"""
    struck: np.ndarray
    """Whether the arm's wrist struck the object, bool: then it may well slip."""


def judge(seen: Seen) -> Held:
    """Return how grasps [E] held in motions [E, steps] as `Grasps.shake` makes them."""
    start = CLOSING * CHUNK - 1
    moved = np.linalg.norm(seen.position[:, start:] - seen.position[:, start, None], axis=-1)
    turned_by = np.einsum("eij,eij->e", seen.rotation[:, start].astype(float), seen.rotation[:, -1]) - 1
    dropped = ~(moved.max(1) < LOST) | ~(seen.force[:, -1] > 0).all(-1)
    angle = np.arccos(np.clip(turned_by / 2, -1, 1))
    return Held(moved[:, -1], angle, seen.overlap[:, start:].max(1), dropped, seen.struck[:, start:].any(1))


def rows(names: list[str], grasps: int, seconds: float, first: int = 0, batch: int = 250) -> Iterator[str]:
    """Yield the rows of the table, one for each object."""
    for name in names:
        held, jaw = [], Grasps([name])
        size = min(batch, grasps)
        for seed in range(first, first - (-grasps // size)):
            held.append(judge(jaw.shake(np.zeros(size, int), seconds, seed)))
        slip, turn, overlap, dropped, struck = (np.concatenate(parts)[:grasps] for parts in zip(*held, strict=True))
        free, kept = ~struck, ~struck & ~dropped
        if not kept.any():
            raise ValueError(f"no grasp of {name} holds it: all {grasps} drop it, or strike it with the wrist")
        slips, turns = 1000 * slip[kept], np.degrees(turn[kept])
        yield (f"| {name} | {grasps} | {free.sum()} | {(dropped & free).sum()} | {(dropped & struck).sum()} "
               f"| {np.median(slips):.3f}, {slips.max():.3f} | {np.median(turns):.2f}, {turns.max():.2f} "
               f"| {1000 * overlap[free].max():.3f} |")  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--grasps", type=whole(1), default=100, metavar="N", help="of each object (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="T", help="of shaking (%(default)s)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="S", help="of the first 250 (%(default)s)")
    arguments = parser.parse_args(argv)
    print("| object | grasps | not struck | of these dropped | of others | slip: median, worst (mm) "
          "| turn: median, worst (degrees) | deepest overlap (mm) |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for row in rows(arguments.objects, arguments.grasps, arguments.seconds, arguments.seed):
        print(row, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run("grasping", main))
