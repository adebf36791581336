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

import mujoco
import numpy as np

from surgical_marl.cache import cached
from surgical_marl.runtime import jax, jnp
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.task import Level, Start, TipTask
from surgical_marl.tasks.base.terms import Picture, Term
from surgical_marl.tasks.base.workspace import CLEARANCE, PATH_POINTS, choose
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene

POSTURES = 1024
"""Number of hidden postures; each has a target picture of 12 KiB."""
NEAREST = 0.02
"""Least distance of the camera from any geom in view, m."""
IN_VIEW = 0.2
"""Least share of a target picture that shows pieces of tissue, and not just the field around them."""
RAYS = 8
"""Rays along each side of a picture, to test which geoms it shows."""


class PictureGoal(NamedTuple):
    """The goal: the pose where the camera should be."""

    targets: Array
    """Tool tips: the camera's at the hidden pose, the others' at home; [arms, 3], m, each in its arm's base frame."""
    row: Array
    """Row of the tables."""


class Task(TipTask):
    """Image matching: goals are hidden postures of the endoscope."""

    levels = {"easy": Level(0.01, 0.0), "default": Level(0.02, 0.0), "hard": Level(0.04, 0.0)}  # noqa: RUF012
    weights = {  # noqa: RUF012
        "image": -10.0, "distance": 0.0, "precision": 0.0, "angle": 0.0, "stray": -10.0, "clearance": -1.0,
        "collision": -2.0,
    }  # fmt: skip
    default_scene = "ecm"
    scenes = ("ecm", "trimanual_psm_ecm")
    senses = ("image_error",)
    wanted = {"median_error_mm": ("below", 2.0)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.camera: str = scene.find_camera()
        same = scene.types[scene.type_of(self.camera)]
        if len(same) > 1:
            raise ValueError(f"match_image needs a scene with one endoscope; {scene.name!r} has {', '.join(same)}")
        self._arm = scene.mounts[self.camera].arm
        table = hidden_postures(scene, self.camera, self.level.extent, self.seed)
        joints = {agent: table[:, scene.qpos_index(agent)] for agent in scene.agents}
        tips = [mount.arm.forward_kinematics(joints[agent])[:, :3, 3] for agent, mount in scene.mounts.items()]
        tables = {"tips": np.stack(tips, 1), "turns": self._turn(joints[self.camera]), "joints": joints[self.camera]}
        self.tables |= {name: np.asarray(values, np.float32) for name, values in tables.items()}
        self.postures = {"hidden": table}
        self.watched = {self.camera: ("image", "target")}

    def start(self, key: Array) -> Start:
        """Return a hidden posture."""
        row = jax.random.randint(key, (), 0, len(self.tables["tips"]))
        return Start(PictureGoal(self.tables["tips"][row], row))

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of an arm, without its target, and the picture to be matched as `target`."""
        terms = super().terms(agent)
        del terms["to_target"]
        return {**terms, "target": Picture(self.camera, table="hidden")}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of every arm, and for the camera's agent both pictures too."""
        vector = tuple(name for name in super().observes(agent) if name not in ("target", "to_target"))
        return (*vector, "image", "target") if agent == self.camera else vector

    @property
    def informed(self) -> str:
        """The camera's agent, which alone sees the target picture."""
        return self.camera

    def privileged(self, goal: PictureGoal) -> Array:
        """Return the joint positions of the camera's arm at the hidden pose."""
        return self.tables["joints"][goal.row]

    @property
    def privileged_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of the joints of the camera's arm."""
        return self._arm.lower, self._arm.upper

    def sense(self, pictures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return `image_error`, the mean absolute difference of both pictures in grey levels, 0 to 255, [N]."""
        seen, wanted = pictures[self.camera]["image"], pictures[self.camera]["target"]
        # in bytes as long as possible, because this moves more memory than drawing does
        if isinstance(seen, np.ndarray):
            error = np.maximum(seen, wanted) - np.minimum(seen, wanted)
            return {"image_error": error.mean((1, 2, 3), dtype=np.float32)}
        import torch

        return {"image_error": (torch.maximum(seen, wanted) - torch.minimum(seen, wanted)).float().mean((1, 2, 3))}

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> reward term -> its value before weighting.

        `image`, `distance`, `precision` and `angle` count for the camera's agent and are 0 for the others. `stray`
        counts for the others and is 0 for the camera's agent. `clearance` and `collision` count for all.
        """
        errors, known, none = self.tip_errors(world), super().reward_terms(world), jnp.float32(0.0)
        looks = {agent: agent == self.camera for agent in world.arms}
        return {
            agent: {
                "image": world.sensed["image_error"] / 255 if looks[agent] else none,
                "distance": errors[agent] if looks[agent] else none,
                "precision": known[agent]["precision"] if looks[agent] else none,
                "angle": self.angle_error(world) if looks[agent] else none,
                "stray": none if looks[agent] else errors[agent],
                **{name: known[agent][name] for name in ("clearance", "collision")},
            }
            for agent in world.arms
        }

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return `tip_error`; and of the camera's agent `angle_error`, rad, and `image_error`, grey levels."""
        found = super().metrics(world)
        found[self.camera] |= {"angle_error": self.angle_error(world), "image_error": world.sensed["image_error"]}
        return found

    def angle_error(self, world: World) -> Array:
        """Return the angle in rad by which the camera is turned away from the hidden pose, about whatever axis."""
        turn = self._turn(world.arms[self.camera].qpos) - self.tables["turns"][world.goal.row]
        chord = jnp.sqrt(jnp.sum(turn * turn)) / np.float32(np.sqrt(8))  # of rotations: sine of half the angle
        return 2 * jnp.arcsin(jnp.minimum(chord, 1.0))

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return the hidden postures."""
        return [self.postures["hidden"][goal.row]]

    def _turn(self, q: Any) -> Any:
        """Return the rotation of the tool tip's frame, [..., 3, 3], at joint positions [..., n]."""
        return self._arm.forward_kinematics(q)[..., :3, :3]


def hidden_postures(scene: Scene, agent: str, extent: float, seed: int = 0) -> np.ndarray:
    """Return postures for target pictures: `qpos` [POSTURES, nq], all arms but the agent's at home.

    Raises:
        ValueError: the scene has no tissue, or the agent can hardly see it.
    """
    model = scene.model
    tissue = np.array([model.geom(geom).name.startswith("tissue/") for geom in range(model.ngeom)])
    if not tissue.any():
        raise ValueError(f"scene {scene.name!r} has no tissue for its endoscope to look at: give it some in its file")
    arm, rng = scene.mounts[agent].arm, np.random.default_rng(seed)
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
    numbers = (extent, seed, POSTURES, *map(float, (*camera.pos, *camera.quat, *camera.fovy)))
    return cached("pictures", lambda: choose(scene, batch, POSTURES, 0.0), repr((agent, numbers)), scene.fingerprint)


def _sees(scene: Scene, agent: str, qpos: np.ndarray, tissue: np.ndarray) -> bool:
    """Return whether enough tissue is in view of the left eye, and nothing too near."""
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
