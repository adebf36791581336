"""Image matching: the endoscope is moved until its picture is a target picture, taken from a hidden pose.

Agents        every arm of the scene. The first arm with a camera matches the picture; the others keep still, since the
              target picture shows their tools at home.
Observation   of the camera's agent a dict: "proprioception" (joint positions and velocities, tool tip, position
              targets; with other arms also as in `reach`), "image" and "target" (what its left eye sees and what it
              should see, uint8 [64, 64, 3]). Of the others the proprioception alone. Nothing tells the hidden pose, but
              the state, which a critic may learn from: it ends with the joint positions there.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        per agent, each step, weights in brackets. The camera's: `image`, the mean absolute difference of the two
              pictures, from 0 to 1 (-10): the paper's, which has no absolute value. Options that help learning and are
              off here, though not in `configs/`: `distance` of the camera from the hidden pose (0 / m), `precision`,
              exp(-distance / 5 mm) (0), `angle` between both views (0 / rad). The others': `stray`, distance of the tip
              from home (-10 / m). All: `clearance` (-1) and `collision` (-2), as in `reach`.
Success       camera within 2 mm of the hidden pose; `angle_error` (rad) and `image_error` (grey levels, 0 to 255) are
              metrics of the camera's agent beside it.
Termination   none; an episode is truncated after 100 control steps (2 s).
Randomisation postures of the endoscope about home, uniform in each joint; kept only if it sees tissue, keeps 20 mm away
              from it, and comes there without collision. Arms start at home.
Difficulty    how far the camera strays along its tube and to each side: easy 10 mm, default 20 mm, hard 40 mm. Angles
              are those at which the tip strays as far from home.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.cache import cached
from surgical_marl.tasks.base import task
from surgical_marl.tasks.base.task import Level, Views
from surgical_marl.tasks.base.workspace import CLEARANCE, PATH_POINTS, choose

if TYPE_CHECKING:
    from surgical_marl.scenes.scene import Scene

POSTURES = 1024
"""How many hidden postures there are; each has a picture of 12 KiB."""
NEAREST = 0.02
"""The camera's least distance from what it sees, m."""
IN_VIEW = 0.2
"""Least share of a target picture that shows pieces of tissue, and not just the field around them."""
RAYS = 8
"""Along each side of a picture, to find out what it shows."""


class PictureGoal(NamedTuple):
    """Where the camera should be."""

    targets: Array
    """Tool tips: the camera's at the hidden pose, the others' at home; [arms, 3], m, each in its arm's base frame."""
    row: Array
    """Of `Task.table`."""


class Task(task.Task):
    """Hidden postures, and how far from them the camera is. Pictures are added where many environments run:
    `surgical_marl/envs/pictures.py`."""

    levels = {"easy": Level(0.01, 0.0), "default": Level(0.02, 0.0), "hard": Level(0.04, 0.0)}  # noqa: RUF012
    weights = {  # noqa: RUF012
        "image": -10.0, "distance": 0.0, "precision": 0.0, "angle": 0.0, "stray": -10.0, "clearance": -1.0,
        "collision": -2.0,
    }  # fmt: skip

    def __init__(self, scene: Scene, difficulty: str = "default", reward: Mapping[str, float] | None = None) -> None:
        super().__init__(scene, difficulty, reward)
        self.camera: str = scene.find_camera()
        same = scene.types[scene.mounts[self.camera].arm.name]
        if len(same) > 1:
            raise ValueError(f"match_image needs a scene with one endoscope; {scene.name!r} has {', '.join(same)}")
        self.table = hidden_postures(scene, self.camera, self.level.extent)
        """`qpos` of the whole scene when a target picture is taken, [rows, nq]."""
        tips, self._arm = [], scene.mounts[self.camera].arm
        for agent, mount in scene.mounts.items():
            q = self.table[:, scene.qpos_index(agent)]
            tips.append(mount.arm.forward_kinematics(q)[:, :3, 3])
            if agent == self.camera:
                self._turns = jnp.asarray(self._turn(q), jnp.float32)
                self._postures = jnp.asarray(q, jnp.float32)
        self._tips = jnp.asarray(np.stack(tips, axis=1), jnp.float32)

    def start(self, key: Array) -> PictureGoal:
        """A hidden posture."""
        row = jax.random.randint(key, (), 0, len(self._tips))
        return PictureGoal(self._tips[row], row)

    def observations(self, views: Views, goal: PictureGoal) -> dict[str, Array]:
        """[d] each, without the targets."""
        known = super().observations(views, goal)
        return {agent: jnp.concatenate(self._without_targets(agent, seen)) for agent, seen in known.items()}

    def bounds(self, agent: str) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest observation of an agent, [d] each."""
        low, high = (np.concatenate(self._without_targets(agent, bound)) for bound in super().bounds(agent))
        return low, high

    def privileged(self, goal: PictureGoal) -> Array:
        """Joint positions of the camera's arm at the hidden pose."""
        return self._postures[goal.row]

    @property
    def privileged_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of those joints."""
        return self._arm.lower, self._arm.upper

    def terms(self, views: Views, goal: PictureGoal) -> dict[str, dict[str, Array]]:
        """agent -> reward term -> its value. `image` is 0 here: pictures are compared where they are drawn."""
        errors, safety, none = self.tip_errors(views, goal), super().terms(views, goal), jnp.float32(0.0)
        return {
            agent: {
                "image": none,
                "distance": errors[agent] if agent == self.camera else none,
                "precision": safety[agent]["precision"] if agent == self.camera else none,
                "angle": self.angle_error(views, goal) if agent == self.camera else none,
                "stray": none if agent == self.camera else errors[agent],
                **{name: safety[agent][name] for name in ("clearance", "collision")},
            }
            for agent in views
        }

    def metrics(self, views: Views, goal: PictureGoal) -> dict[str, dict[str, Array]]:
        """`angle_error` of the camera's agent, rad."""
        return {
            agent: {"angle_error": self.angle_error(views, goal)} if agent == self.camera else {} for agent in views
        }

    def angle_error(self, views: Views, goal: PictureGoal) -> Array:
        """Angle in rad by which the camera is turned away from the hidden pose, about whatever axis."""
        turn = self._turn(views[self.camera].qpos) - self._turns[goal.row]
        chord = jnp.sqrt(jnp.sum(turn * turn)) / np.float32(np.sqrt(8))  # of rotations: sine of half the angle
        return 2 * jnp.arcsin(jnp.minimum(chord, 1.0))

    def _turn(self, q: Array | np.ndarray) -> Array:
        """Rotation of the tool tip's frame, [..., 3, 3], from joints [..., n]."""
        pose: Array = self._arm.forward_kinematics(q)[..., :3, :3]
        return pose

    def _without_targets(self, agent: str, values: Any) -> list[Any]:
        n = len(self.scene.mounts[agent].arm.actuated)
        return [values[: 3 * n + 3], values[3 * n + 9 :]]


def hidden_postures(scene: Scene, agent: str, extent: float) -> np.ndarray:
    """Postures that target pictures are taken from: `qpos` [POSTURES, nq], all arms but the agent's at home.

    Raises:
        ValueError: the scene has no tissue, or the agent can hardly see it.
    """
    model = scene.model
    tissue = np.array([model.geom(geom).name.startswith("tissue/") for geom in range(model.ngeom)])
    if not tissue.any():
        raise ValueError(f"scene {scene.name!r} has no tissue for its endoscope to look at: give it some in its file")
    arm, rng = scene.mounts[agent].arm, np.random.default_rng(0)
    reach = np.linalg.norm(arm.forward_kinematics(arm.home)[:3, 3])
    spread = np.array([extent if joint.slides else extent / reach for joint in arm.actuated])
    home = {name: mount.arm.home for name, mount in scene.mounts.items()}

    def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
        q = arm.home + rng.uniform(-spread, spread, (POSTURES, len(spread)))
        ways = [{**home, agent: arm.home + share * (q - arm.home)} for share in np.linspace(0, 1, PATH_POINTS + 1)[1:]]
        least = np.min([np.broadcast_to(scene.clearance(way), POSTURES) for way in ways], axis=0)
        good = ((q >= arm.lower) & (q <= arm.upper)).all(-1) & (least > CLEARANCE)
        qpos = scene.full_qpos({**home, agent: q})
        good[good] = [_sees(scene, agent, posture, tissue) for posture in qpos[good]]
        return qpos[good], np.zeros(good.sum(), bool)

    camera = model.camera(f"{agent}/left")
    numbers = (extent, POSTURES, *map(float, (*camera.pos, *camera.quat, *camera.fovy)))
    return cached("pictures", lambda: choose(scene, batch, POSTURES, 0.0), repr((agent, numbers)), scene.fingerprint)


def _sees(scene: Scene, agent: str, qpos: np.ndarray, tissue: np.ndarray) -> bool:
    """Whether enough tissue is in view of the left eye, and nothing too near."""
    data, count = mujoco.MjData(scene.model), RAYS * RAYS
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_camlight(scene.model, data)
    camera, half = data.cam(f"{agent}/left"), np.tan(np.radians(scene.model.camera(f"{agent}/left").fovy[0]) / 2)
    side = half * (2 * (np.arange(RAYS) + 0.5) / RAYS - 1)
    rays = np.stack([*np.meshgrid(side, side), -np.ones((RAYS, RAYS))], axis=-1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ camera.xmat.reshape(3, 3).T
    geom, distance = np.empty(count, np.int32), np.empty(count)
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    mujoco.mj_multiRay(
        scene.model, data, camera.xpos, rays.ravel(), groups, True, -1, geom, distance, None, count, 1e10
    )
    hit = geom >= 0
    return bool(np.mean(hit & tissue[geom]) >= IN_VIEW and (distance[hit] > NEAREST).all())
