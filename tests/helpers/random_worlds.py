"""Random worlds for the pure functions of tasks: arms, and a needle about where it should be and where it was."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from surgical_marl.physics.outputs import ArmView, Handled, ObjectView
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grasp_poses import bars
from surgical_marl.tasks.base.object_task import Best, ObjectGoal, ObjectTask
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.world import World

ROWS, NEEDLE = 4, "needle"
ONE, TWO, THREE = "psm_needle", "bimanual_psm_needle", "trimanual_psm_ecm_needle"
WORLDS = range(40)


class Bring(ObjectTask):
    """Bringing a needle from random places to random goals."""

    levels = {"default": SimpleNamespace(oriented=True), "easy": SimpleNamespace(oriented=False)}  # noqa: RUF012

    def __init__(self, scene: Any, options: Options) -> None:
        self.hands = 1 if len(scene.agents) == 1 else 2
        super().__init__(scene, options)
        rng = np.random.default_rng(0)
        turns, goals = Rotation.random(ROWS, rng=rng), np.tile(np.eye(4), (ROWS, 1, 1))
        goals[:, :3, :3], goals[:, :3, 3] = Rotation.random(ROWS, rng=rng).as_matrix(), rng.normal(0, 0.02, (ROWS, 3))
        self._set_tables(np.hstack([rng.normal(0, 0.02, (ROWS, 3)), turns.as_quat(scalar_first=True)]), goals)

    def start(self, key: Any) -> Start:
        return Start(ObjectGoal(key, self.nothing), poses={NEEDLE: Pose(key, key)})


@cache
def bring(scene: str, difficulty: str = "default") -> Any:
    return Bring(load_scene(scene), Options("needle_pick", scene, difficulty=difficulty))


def drawn(task: Any, seed: int) -> tuple[World, Any, int]:
    """A world in which the needle is about where it should be, and about where it was; a generator; the goal's row."""
    rng, row = np.random.default_rng(seed), seed % ROWS
    chance = lambda share: np.bool_(rng.random() < share)  # noqa: E731
    scene, point = task.scene, task.scene.objects[NEEDLE].object.sites["tip"][0]
    turn = (Rotation.from_rotvec(rng.normal(0, 0.12, 3)) * Rotation.from_matrix(task.goals[row, :3, :3])).as_matrix()
    size = float(rng.uniform(0.5, 1.5))
    place = task.tables["points"][row] + rng.normal(0, 0.0015, 3) - size * turn @ point
    if chance(0.3):
        place[2] = task.tables["starts"][row, 2] + rng.uniform(-0.05, 0.03)
    body: Any = ObjectView(place, turn, rng.normal(size=6), size)  # type: ignore[arg-type]
    arms: dict[str, Any] = {}
    for agent, mount in scene.mounts.items():
        n, holds = len(mount.arm.actuated), chance(0.5)
        force = rng.uniform(0, 3) * (holds or chance(0.2))
        tip = (place + rng.normal(0, 0.02, 3) - mount.position) @ mount.rotation
        arms[agent] = ArmView(
            rng.uniform(mount.arm.lower, mount.arm.upper), rng.normal(size=n), rng.normal(size=n),
            tip, Rotation.random(rng=rng).as_matrix(), rng.normal(0, 0.1, 3), np.float32(rng.uniform(-0.01, 0.05)),
            chance(0.5), np.float32(rng.uniform(0, 5)), np.float32(rng.uniform(0, 2)), np.int32(0),
            {NEEDLE: Handled(np.float32(force), holds, np.float32(rng.uniform(0, 0.01)))},
        )  # fmt: skip
    first = chance(0.2)
    best = Best(*map(np.float32, (rng.uniform(0, 0.05), chance(0.5), 1.0 if chance(0.5) else rng.uniform(0, 1),
                                  -1.0 if first else rng.uniform(0, 0.03), -1.0 if first else rng.uniform(0, 1))))  # type: ignore[arg-type]  # fmt: skip
    changes = {agent: rng.normal(size=len(mount.arm.actuated)) for agent, mount in scene.mounts.items()}
    return World(arms, ObjectGoal(np.int32(row), best), objects={NEEDLE: body}, changes=changes), rng, row  # type: ignore[arg-type]


def tool(scene: Any, agent: str, view: Any) -> np.ndarray:
    mount = scene.mounts[agent]
    return mount.position + mount.rotation @ view.tool_tip


def bars_of(scene: Any, body: Any) -> np.ndarray:
    """The middles of the needle's capsules in the world."""
    capsules = [shape for shape in scene.objects[NEEDLE].object.shapes if shape.kind == "capsule"]
    assert capsules
    middles, _ = bars(scene.objects[NEEDLE].object)
    return np.array([body.position + body.size * body.rotation @ middle for middle in middles])
