"""Draw starts of camera assistance on the host: postures of the endoscope, and goals that it can show."""

from __future__ import annotations

import numpy as np

from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.scene import Scene
from surgical_marl.tasks import needle_handover, peg_transfer, reach
from surgical_marl.tasks.base.grasp_poses import tool_of
from surgical_marl.tasks.base.task import Task
from surgical_marl.tasks.base.workspace import CLEARANCE, PATH_POINTS, choose
from surgical_marl.tasks.camera_assist.eye import Eye

ROWS = 2048
"""Number of postures of the endoscope at the start, and of goals of `reach`."""
DEEPEST = 0.1
"""Greatest insertion of the endoscope at the start, m: its tip stays 40 mm or more above what lies in the scenes."""
INNER = 0.85
"""At targets of `reach` all is in this share of the picture."""


def find_roles(scene: Scene) -> tuple[str, tuple[str, ...]]:
    """Return the agent with an endoscope, and the two others, which are tools.

    ValueError if a scene has other arms.
    """
    camera = scene.find_camera()
    tools = tuple(agent for agent in scene.agents if agent != camera and scene.mounts[agent].arm.camera is None)
    if len(tools) != 2 or len(scene.agents) != 3:
        raise ValueError(
            f"camera_assist needs a scene with one endoscope and two other arms; {scene.name!r} has "
            f"{', '.join(scene.agents)}"
        )
    return camera, tools


def work_in(scene: Scene) -> tuple[str, type[Task]]:
    """Return the name and the class of the task that the tools of a scene work at."""
    if not scene.free_objects:
        return "reach", reach.Task
    needles = any(peg_transfer.Task.point not in place.object.sites for place in scene.free_objects.values())
    return ("needle_handover", needle_handover.Task) if needles else ("peg_transfer", peg_transfer.Task)


def draw_postures(scene: Scene, camera: str, tools: tuple[str, ...], turn: float, sees: bool, seed: int) -> np.ndarray:
    """Return `qpos` [ROWS, nq] of the whole scene in which the tools are at home and the endoscope is turned away.

    The endoscope is clear of the tools, also on the straight way in joint space to a posture that looks at them.

    Args:
        turn: how far each of its joints that turn is away from that posture, at most, rad. It is inserted by up to
            `DEEPEST`.
        sees: whether it sees all tools.
        seed: of the draws.

    Raises:
        ValueError: hardly a draw can be kept.
    """
    rng, eye = np.random.default_rng(seed), Eye(scene.mounts[camera])
    arm, home = eye.mount.arm, {agent: mount.arm.home[None] for agent, mount in scene.mounts.items()}
    tips = np.stack([tool_of(scene.mounts[agent], home[agent])[:, :3, 3] for agent in tools], 1)
    looks, slides = eye.look_at(tips, home[camera]), np.array([joint.slides for joint in arm.actuated])

    def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
        turned = looks + rng.uniform(-turn, turn, (ROWS, len(slides)))
        q = np.where(slides, rng.uniform(0.0, DEEPEST, (ROWS, 1)), turned)
        good = ((q >= arm.lower) & (q <= arm.upper)).all(-1)
        for share in np.linspace(0.0, 1.0, PATH_POINTS + 1):
            way = {**home, camera: (1 - share) * q + share * looks}
            good &= (scene.clearance(way) > CLEARANCE) & (scene.clearance(way, within=True) > 0)
        axes, origin = eye.pose(q)
        good &= (not sees) | eye.sees((tips - origin[:, None]) @ axes).all(-1)
        return scene.full_qpos({**home, camera: q})[good], np.zeros(good.sum(), bool)

    return choose(scene, batch, ROWS, 0.0)


def visible_targets(scene: Scene, camera: str, tools: tuple[str, ...], targets: np.ndarray) -> np.ndarray:
    """Return targets of `reach` [ROWS, arms, 3] that the endoscope can see at once, with the tools at home.

    Tools on their straight way to them are clear of the endoscope in that posture.

    Args:
        targets: of all arms, each in its base frame, m, [rows, arms, 3]. Some may be returned more than once.

    Raises:
        ValueError: hardly a row can be kept.
    """
    eye, numbers = Eye(scene.mounts[camera]), {agent: scene.agents.index(agent) for agent in tools}
    places, ends = [], {}
    for agent, number in numbers.items():
        mount = scene.mounts[agent]
        places.append(targets[:, number] @ mount.rotation.T + mount.position)
        places.append(np.broadcast_to(tool_of(mount, mount.arm.home)[:3, 3], places[-1].shape))
        ends[agent] = inverse_kinematics(mount.arm, targets[:, number], starts=1)
    both = np.stack(places, 1)
    q = eye.look_at(both, np.tile(eye.mount.arm.home, (len(both), 1)))
    axes, origin = eye.pose(q)
    good = eye.sees((both - origin[:, None]) @ axes * [1 / INNER, 1 / INNER, 1.0]).all(-1)
    for share in np.linspace(0.0, 1.0, PATH_POINTS + 1):
        way = {agent: (1 - share) * scene.mounts[agent].arm.home + share * end for agent, end in ends.items()}
        good &= scene.clearance({**way, camera: q}) > CLEARANCE
    rows = np.flatnonzero(good)
    if len(rows) < ROWS / 4:
        raise ValueError(
            f"scene {scene.name!r}: {camera!r} can see {len(rows)} of {len(targets)} pairs of targets at once; move it "
            "back or the arms' workspace points together"
        )
    return targets[np.resize(rows, ROWS)]
