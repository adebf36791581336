"""Grasps of objects that are shaken, or that two arms pull at, and what is seen of them.

grasps = Grasps(["needle_sh"], arms=2)
held = np.zeros(100, int)
seen = grasps.pull(grasps.begin(held, seed=0), held, seconds=10.0, seed=0)
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.bench.physics import bare_state
from surgical_marl.engines.choose import Engine, make_engine
from surgical_marl.envs.env import Env
from surgical_marl.envs.state import Carry, State
from surgical_marl.physics.state import Physics
from surgical_marl.physics.systems.rigid_motion import rotation
from surgical_marl.robots.rotation import quaternion
from surgical_marl.scenes.grasps import Jaw

OBJECTS = {"needle_sh": "grasp", "needle_40": "grasp", "block": "grasp_0"}
"""Objects, and the site at which each is grasped: its x axis is along the wire or bar."""
CONTROL = 0.02
"""Control step, s."""
CHUNK = 12
"""Control steps between two changes of direction, 0.24 s."""
CLOSING, RESTING = 3, 2
"""Chunks in which the jaw closes at the start, and in which the arm stands at the end."""
CLOSE = 2e-4
"""An object this near to another part of an arm counts as struck by it, m."""
DRAWS = 1000
"""Grasps that are drawn at most until one is as it should be."""
PULL, TURN = 1e-4, np.radians(0.25)
"""How far each of two arms is told to go from where it grasped, in each direction, m, and about each axis, rad."""
ARMS = (
    ["  psm_0: {arm: psm, position: [0.0, 0.0, 0.15]}"],
    [
        "  psm_0: {arm: psm, position: [-0.0855, 0.0, 0.15], turn: -20.0, tilt: [0.0, -34.25, 0.0]}",
        "  psm_1: {arm: psm, position: [0.0855, 0.0, 0.15], turn: 20.0, tilt: [0.0, 34.25, 0.0]}",
    ],
)
"""One PSM that stands upright, or two as in the scene `bimanual_psm_needle`."""


class Seen(NamedTuple):
    """What is seen of the object at the end of control steps [...], of a arms."""

    position: Any
    """Centre of mass in the frame of each arm's finger pair, m, [..., a, 3]."""
    rotation: Any
    """Axes likewise, [..., a, 3, 3]."""
    force: Any
    """Normal forces of the two fingers, N, [..., a, 2]."""
    holding: Any
    """True if the arm holds it, [..., a]."""
    overlap: Any
    """The deepest overlap with fingers in all physics steps of the control step, m, [...]."""
    struck: Any
    """True if another part of an arm was at the object in one of these steps, [...] bool."""
    place: Any
    """Centre of mass in the world, m, [..., 3]."""
    command: Any
    """Commands of all actuators, [..., nu]."""


class Watched(Env):
    """An environment without a task that says what is seen of an object. `goal` is the number of that object."""

    def __init__(self, scene: Path) -> None:
        super().__init__("reach", str(scene))
        self.task_name, self.parameters = "grasps", {}

    @property
    def pauses(self) -> bool:
        """Always False: there are no pictures."""
        return False

    def reset(self, key: Array, episode: Array | int = 0, parameters: Any = None) -> State:
        """Return the state with the arms at home."""
        carry = Carry(self.simulator.home, jnp.int32(0), key, jnp.int32(episode), jnp.int32(0))
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(self._look, carry))
        return self._state(carry, nothing)

    def step(self, carry: Carry, actions: dict[str, Array], parameters: Any = None) -> State:
        """Do one control step."""
        simulator = self.simulator
        physics = self.controller.apply(carry.physics, actions)

        def substep(state: tuple[Physics, Array, Array], _: None) -> tuple[tuple[Physics, Array, Array], None]:
            physics, overlap, struck = state
            physics, _touch = simulator.step(physics, simulator.untouched)
            deep, near = self._depths(physics)
            return (physics, jnp.maximum(overlap, deep), struck | (near > -CLOSE)), None

        begin = physics, jnp.float32(-1.0), jnp.bool_(False)
        (physics, overlap, struck), _ = jax.lax.scan(substep, begin, None, length=simulator.decimation)
        carry = carry._replace(physics=physics)
        return self._state(carry, self._look(carry)._replace(overlap=overlap, struck=struck))

    @property
    def fingers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of the two fingers of each arm, [a, 2], and those of their bodies in the scene's model."""
        assert self.simulator.step.bodies
        tables = self.simulator.step.bodies.tables
        fingers = np.array([tables.jaws[arm] for arm in range(tables.arms)])
        return fingers, tables.bodies["pads"][fingers]

    def _depths(self, physics: Physics) -> tuple[Array, Array]:
        """Return how deep objects overlap with fingers, and how deep with other parts of arms, m."""
        step = self.simulator.step
        assert step.bodies
        tables, depth = step.bodies.tables, step.depths(physics)
        grips, on_arm = tables.finger < len(tables.fingers), tables.owner < tables.arms
        return jnp.max(jnp.where(grips, depth, -1.0)), jnp.max(jnp.where(on_arm & ~grips, depth, -1.0))

    def _look(self, carry: Carry) -> Seen:
        step, physics, held = self.simulator.step, carry.physics, carry.goal
        bodies = physics.rigid_bodies.bodies
        data, axes = step.arms.dynamics.pose(physics.qpos), rotation(bodies.quaternion)
        place = bodies.position
        fingers, links = self.fingers
        frames, offset = in_jaws(jnp, data.xpos[links], data.xmat[links], place[held])
        holds = [
            jnp.stack([h.holding for h in step.grips.view(physics.rigid_bodies.grips, a).values()])
            for a in range(len(links))
        ]
        return Seen(
            position=offset,
            rotation=frames @ axes[held],
            force=physics.rigid_bodies.grips.force[held][fingers],
            holding=jnp.stack(holds)[:, held],
            overlap=jnp.float32(0.0),
            struck=jnp.bool_(False),
            place=place[held],
            command=physics.ctrl,
        )

    def _state(self, carry: Carry, seen: Seen) -> State:
        _, distance = self.simulator._look(carry.physics.qpos)
        return bare_state(carry, distance, {"seen": seen._asdict()})


def in_jaws(xp: Any, position: Any, rotation: Any, place: Any) -> tuple[Any, Any]:
    """Return the axes of the frames of jaws, [a, 3, 3], and where a place is in them, m, [a, 3].

    Args:
        xp: numpy or JAX's.
        position: of each jaw's two fingers in the world, m, [a, 2, 3]: a frame begins midway between them.
        rotation: of these fingers, [a, 2, 3, 3].
        place: in the world, m, [3].
    """
    along, down = (rotation[..., axis].sum(1) for axis in (1, 2))
    along, down = (way / xp.sqrt(xp.sum(way * way, -1, keepdims=True)) for way in (along, down))
    frames = xp.stack([xp.cross(along, down), along, down], -2)
    return frames, (frames @ (place - position.sum(1) / 2)[..., None])[..., 0]


class Grasps:
    """One PSM, or two, that grasp one of some objects in the air, in environments side by side. All others fall.

    Args:
        objects: their names or files. One that isn't in `OBJECTS` has a site `grasp`.
        arms: how many grasp the object, 1 or 2.
        struck: whether one arm also grasps an object where its own wrist can strike it. Two arms, which hardly turn
            their wrists, do so anyway.
    """

    def __init__(self, objects: Sequence[str], arms: int = 1, struck: bool = False) -> None:
        self._env, self._struck = env_of(objects, arms), struck or arms > 1
        self.scene, self.simulator = self._env.scene, self._env.simulator
        self.names, self.agents = tuple(self.scene.objects), self.scene.agents
        self.fingers = [[self.scene.model.body(int(body)).name for body in jaw] for jaw in self._env.fingers[1]]
        """Names of the two fingers of each arm."""
        self._jaws = [Jaw(self.scene, agent) for agent in self.agents]
        self._engine = lru_cache(1)(self._make_engine)

    def begin(self, held: np.ndarray, seed: int = 0) -> Physics:
        """Return states [E]: the arms anywhere, their jaws around the object without touching it.

        Args:
            held: number of the object that is between the pads, [E].
            seed: of the random numbers.
        """
        rng = np.random.default_rng(seed)
        drawn = zip(*(self._draw(rng, self.names[o]) for o in held), strict=True)
        qpos, position, turn = (jnp.asarray(np.array(part), jnp.float32) for part in drawn)
        physics, each = jax.vmap(self.simulator.at)(qpos), np.arange(len(held))
        bodies = physics.rigid_bodies.bodies
        placed = bodies._replace(
            position=bodies.position.at[each, held].set(position),
            quaternion=bodies.quaternion.at[each, held].set(turn),
        )
        return physics.with_systems(rigid_bodies=physics.rigid_bodies._replace(bodies=placed))

    def play(self, physics: Physics, actions: np.ndarray, held: np.ndarray) -> tuple[Physics, Seen]:
        """Return states [E] after actions [E, steps, a, n], and what was seen of the held objects, [E, steps]."""
        engine, seen = self._engine(len(held)), []
        leaves, tree = jax.tree_util.tree_flatten_with_path(physics)
        names = [f".physics{jax.tree_util.keystr(path)}" for path, _ in leaves]
        for name, (_, leaf) in zip(names, leaves, strict=True):
            engine.write(name, np.asarray(leaf))
        engine.write(".goal", held.astype(np.int32))
        for t in range(actions.shape[1]):
            engine.step({agent: actions[:, t, a].astype(np.float32) for a, agent in enumerate(self.agents)})
            seen.append(Seen(**engine.outcome("numpy")["infos"]["seen"]))
        after = jax.tree.unflatten(tree, [engine.read(name, "numpy") for name in names])
        return after, Seen(*(np.stack(parts, 1) for parts in zip(*seen, strict=True)))

    def still(self, count: int, chunks: int = 1) -> np.ndarray:
        """Return actions [E, steps, a, n] of arms that stand with closing jaws."""
        actions = np.zeros((count, chunks * CHUNK, len(self.agents), self._env.num_actions(self.agents[0])), np.float32)
        actions[..., -1] = -1.0
        return actions

    def shake(self, physics: Physics, held: np.ndarray, seconds: float, seed: int = 0) -> Seen:
        """Return what is seen [E, steps] of grasps that close, are shaken at full speed and stand still again.

        Arguments are as for `pull`.
        """
        rng = np.random.default_rng(seed + 1)
        actions = self.still(len(held), CLOSING + _chunks(seconds) + RESTING)
        for chunk in range(CLOSING, CLOSING + _chunks(seconds)):
            ways = rng.choice([-1.0, 1.0], (len(held), 1, *actions.shape[2:]))
            actions[:, chunk * CHUNK : (chunk + 1) * CHUNK, :, :-1] = ways[..., :-1]
        return self.play(physics, actions, held)[1]

    def pull(self, physics: Physics, held: np.ndarray, seconds: float, seed: int = 0, share: float = 1.0) -> Seen:
        """Return what is seen [E, steps] of grasps that close, pull and turn against each other, and let go of that.

        Each arm's tip is told to go to random places near where it grasped, and back at the end.

        Args:
            physics: states at the start, as `begin` returns them.
            held: number of the object, [E].
            seconds: how long they move, in changing directions.
            seed: of the random numbers.
            share: of `PULL` and `TURN`.
        """
        rng = np.random.default_rng(seed + 1)
        physics, closing = self.play(physics, self.still(len(held), CLOSING), held)
        reach = share * np.repeat([PULL, TURN], 3)
        tips = rng.uniform(-1, 1, (len(held), _chunks(seconds), len(self.agents), 6)) * reach
        tips = np.concatenate([tips, 0 * tips[:, :1]], 1)  # and back
        ways = np.diff(tips, axis=1, prepend=0.0) / CHUNK
        actions = self.still(len(held), tips.shape[1] + RESTING)
        for a, agent in enumerate(self.agents):
            arm, qpos = self.scene.mounts[agent].arm, np.asarray(physics.qpos)[:, self.scene.qpos_index(agent)]
            full = CONTROL * np.array([joint.drive.speed for joint in arm.actuated])
            moves = np.stack(
                [
                    np.linalg.lstsq(j, own.T, rcond=None)[0].T
                    for j, own in zip(_jacobians(arm, qpos), ways[:, :, a], strict=True)
                ]
            )
            actions[:, : tips.shape[1] * CHUNK, a, :-1] = np.repeat(moves / full[:-1], CHUNK, 1)
        assert np.abs(actions).max() <= 1
        seen = self.play(physics, actions, held)[1]
        return Seen(*(np.concatenate(parts, 1) for parts in zip(closing, seen, strict=True)))

    def _draw(self, rng: np.random.Generator, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return qpos, and the object's centre of mass and quaternion: between the pads, and not in the wrist's way."""
        item = self.scene.objects[name].object
        for _ in range(DRAWS):
            first, *others = rng.permutation(len(self._jaws))
            grasp = self._jaws[first].draw(name, item.sites[OBJECTS.get(name, "grasp")], rng)
            joints: dict[str, np.ndarray | None] = {self.agents[first]: grasp.q}
            for other in others:
                joints[self.agents[other]] = self._jaws[other].join(name, grasp, {self.agents[first]: grasp.q}, rng)
            q = {agent: own for agent, own in joints.items() if own is not None}
            if len(q) == len(joints) and (self._struck or self._jaws[first].clears_wrist(name, grasp)):
                place = grasp.position + grasp.rotation @ item.center
                return self.scene.full_qpos(q), place, quaternion(grasp.rotation)
        raise ValueError(f"all of {DRAWS} random grasps of {name!r} are out of reach or in the way of the arm's wrist")

    def _make_engine(self, count: int) -> Engine:
        engine = make_engine(self._env, count)
        engine.reset(0)
        return engine


def _chunks(seconds: float) -> int:
    return max(1, round(seconds / CONTROL / CHUNK))


def _jacobians(arm: Any, q: np.ndarray) -> np.ndarray:
    """Return how the tip [E, 6] moves and turns, by the axes of the arm's base, with all joints but the jaw."""
    columns, step = [], 1e-5
    for joint in range(q.shape[-1] - 1):
        nudge = step * (np.arange(q.shape[-1]) == joint)
        ahead, behind = (arm.forward_kinematics(q.astype(float) + way * nudge) for way in (1, -1))
        turn = (ahead[:, :3, :3] - behind[:, :3, :3]) @ np.swapaxes(ahead[:, :3, :3], 1, 2)
        about = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
        columns.append(np.concatenate([ahead[:, :3, 3] - behind[:, :3, 3], about], -1) / (2 * step))
    return np.stack(columns, -1)


def env_of(objects: Sequence[str], arms: int = 1) -> Watched:
    """Return an environment of one PSM, or two, and some objects in the air, by their names or files."""
    places = [f"  {Path(o).stem}: {{object: {o}, position: [{0.1 * i}, 0.3, 0.0]}}" for i, o in enumerate(objects)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "psm_in_the_air.yaml"
        path.write_text("\n".join(["arms:", *ARMS[arms - 1], "objects:", *places]), encoding="utf-8")
        return Watched(path)
