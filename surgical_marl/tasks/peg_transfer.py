"""Peg transfer: an arm lifts a block off its peg and puts it on another one.

The first task of the Fundamentals of Laparoscopic Surgery, on the board of the ICRA 2026 challenge.

Agents        the arms of the scene. The first one whose jaw has pads moves the block; the others keep out of its way.
Observation   as in `needle_pick`; the goal is where the middle of the block's underside should be.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best of
              the episode so far: `reach`, tool to block (20 / m); `grasp` (2); `lift`, over 10 mm of height (2); `over`,
              the held block over its goal, clear of the pegs (4); `carry`, block to goal while it is held (40 / m).
              `precision`, exp(-error / 5 mm) while held (0.1); `success` (0.5); `drop` (-2); `clearance` (-1),
              `collision` (-2).
Success       the block stands on its goal peg, less than 2 mm above the plate, and no finger touches it.
Termination   when the block, once lifted, is touched by no finger and is on no peg, or falls off the board; an episode
              is truncated after 300 control steps (6 s).
Randomisation the block stands on any peg of the arm's side of the wall, turned and shifted at random as far as the peg
              lets it. Its goal is another peg of that side. Kept only if the arm reaches a grip at both, off its joints'
              limits. Arms start at home.
Difficulty    easy: the goal is one of the nearest pegs, 20 or 30 mm away. default: any peg of that side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grips import DOWN, frames, joints_at, moved, tool_of, tool_poses
from surgical_marl.tasks.base.object_task import NEAR, Best, Now, ObjectTask
from surgical_marl.tasks.base.script import Snapshot, Step, Wish
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.workspace import choose

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Mount, Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 2048
AROUND = 0.0035
"""A block is around a peg where the axes of its hole and of the peg are nearer than this, m. Up to 2.7 mm are free."""
STANDS = 0.002
"""Greatest height of a block's underside above the plate where it stands there, m."""
SHIFT = 0.0015
"""Greatest distance of a block from its peg's axis at the start, m."""
CLEAR = 0.024
"""Height of a block's underside above the plate from which on it is clear of the pegs, m: these are 20 mm high."""
PAST, OUT, WIDE = 0.0025, 0.0009, 0.45
"""How far the oracle's tool tip goes past the bar and is outside it, m, and the share by which its jaw opens: the inner
finger goes between bar and peg."""
OVER, RAISE = 0.012, 0.030
"""How far the tool tip stops above the bar, and how far it lifts the block, m."""


class PegLevel(NamedTuple):
    """A level of difficulty."""

    distance: float
    """Greatest distance of the goal from the start, m."""
    oriented: bool = False
    """Whether the goal has an orientation."""


class PegGoal(NamedTuple):
    """The goal of an episode, and what was reached of it."""

    row: Array
    """Row of the tables."""
    best: Best
    over: Array
    """1 once the held block was over its goal."""


class Task(ObjectTask):
    """Moving a block from peg to peg."""

    levels = {"easy": PegLevel(0.032), "default": PegLevel(1.0)}  # noqa: RUF012
    weights = {**ObjectTask.weights, "over": 4.0, "success": 0.5}  # noqa: RUF012
    default_scene = "bimanual_psm_pegs"
    scenes = ("bimanual_psm_pegs", "trimanual_psm_ecm_pegs")
    hands = 2
    point = "base"
    max_steps = 300
    stages = ("reached", "grasped", "lifted", "over", "at_goal")
    wanted = {"success_rate": ("at least", 0.95), "drop_rate": ("below", 0.02)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.presenter = self.picker
        self._item = scene.objects[self.object].object
        self._pegs = find_pegs(scene, options.task).astype(np.float32)
        about = repr((self.object, self.level, self.seed, SHIFT, PAST, OUT, OVER, RAISE, CLEAR))
        table = cached("peg_transfer", lambda: self._draw(scene), about, scene.fingerprint, self._item.content)
        self._set_tables(table[:, :7], frames(table[:, 7:10], table[:, 10:14]))
        self.grips = table[:, 14].astype(int)
        """Of the oracle: the number of the site that it grips."""

    def start(self, key: Array) -> Start:
        """Return where the block stands, and the goal."""
        row = jax.random.randint(key, (), 0, ROWS)
        place = self.tables["starts"][row]
        goal = PegGoal(row, self.nothing, jnp.float32(0.0))
        return Start(goal, poses={self.object: Pose(place[:3], place[3:])})

    # -- what is measured

    def now(self, world: World) -> Now:
        """Return what is measured in a world; a block that is around a peg is not dropped."""
        now = super().now(world)
        away = self._base(world)[:2] - self._pegs[:, :2]
        around = jnp.min(jnp.sum(away * away, -1)) < AROUND**2
        return now._replace(dropped=now.dropped & ~(around & (self._height(world) > -STANDS)))

    def over(self, world: World) -> Array:
        """Return whether the block is held over its goal, clear of the pegs, [] bool."""
        away = (self._base(world) - self.tables["points"][world.goal.row])[:2]
        held = world.arms[self.picker].handles[self.object].holding
        return held & (jnp.sum(away * away) < AROUND**2) & (self._height(world) > CLEAR - STANDS)

    def stands(self, world: World) -> Array:
        """Return whether the block stands on its goal peg and no finger touches it, [] bool."""
        away = (self._base(world) - self.tables["points"][world.goal.row])[:2]
        loose = jnp.stack([view.handles[self.object].force <= 0 for view in world.arms.values()]).all()
        return loose & (jnp.sum(away * away) < AROUND**2) & (jnp.abs(self._height(world)) < STANDS)

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far."""
        over = jnp.maximum(world.goal.over, self.over(world).astype(jnp.float32))
        return super().remember(world)._replace(over=over)

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task that brings an object to a goal, and `over`, when it is first over its goal."""
        over = jnp.maximum(self.over(world).astype(jnp.float32) - world.goal.over, 0.0)
        more = {"over": over, "success": self.stands(world).astype(jnp.float32)}
        return {agent: {**terms, **more} for agent, terms in super().reward_terms(world).items()}

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the block stands on its goal peg, for all agents."""
        return dict.fromkeys(world.arms, self.stands(world))

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all arms."""
        now = self.now(world)
        held = now.held[self.picker]
        found = {
            "reached": now.reach[self.picker] < NEAR,
            "grasped": held,
            "lifted": held & (now.lift >= 1.0),
            "over": self.over(world),
            "at_goal": self.stands(world),
        }
        return dict.fromkeys(world.arms, found)

    def _base(self, world: World) -> Array:
        """Return the middle of the block's underside in the world, [3], m."""
        body = world.objects[self.object]
        return body.position + body.rotation @ self._point

    def _height(self, world: World) -> Array:
        """Return its height above the plate, [] m."""
        return self._base(world)[2] - self._pegs[0, 2]

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how the arm does it: over a bar, down, close, up, over the goal, down, open, up."""
        agent, mount = self.picker, self.scene.mounts[self.picker]

        def grip(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            tool = gripping(mount, seen.objects[self.object], self._sites[self.grips[seen.goal.row]], beyond)
            return {agent: Wish(tool, opens=WIDE)}

        def raised(seen: Snapshot, height: float, opens: float = 0.0) -> dict[str, Wish]:
            return {agent: Wish(moved(seen.tools[agent], [0.0, 0.0, height]), opens)}

        def carry(seen: Snapshot, height: float) -> dict[str, Wish]:
            held = np.linalg.inv(seen.objects[self.object]) @ seen.tools[agent]
            return {agent: Wish(moved(self.goals[seen.goal.row], [0.0, 0.0, height]) @ held)}

        def holds(seen: Snapshot) -> np.ndarray:
            return seen.held[agent][:, self._number]

        return (
            Step(lambda seen: grip(seen, -OVER), wait=0.1),
            Step(lambda seen: grip(seen, PAST), wait=0.1, pace=0.3),
            Step(lambda seen: {agent: Wish()}, wait=0.3, good=holds),
            Step(lambda seen: raised(seen, RAISE / 2), pace=0.3, good=holds),
            Step(lambda seen: raised(seen, RAISE / 2), wait=0.1, pace=0.4),
            Step(lambda seen: carry(seen, RAISE), wait=0.1, pace=0.5),
            Step(lambda seen: carry(seen, RAISE / 2), pace=0.3),
            Step(lambda seen: carry(seen, 0.0005), wait=0.1, pace=0.3),
            Step(lambda seen: {agent: Wish(opens=WIDE)}, wait=0.2),
            Step(lambda seen: raised(seen, RAISE / 2, WIDE), pace=0.3),
            Step(lambda seen: {agent: Wish(opens=WIDE)}),
        )

    # -- where blocks and goals are drawn

    def _draw(self, scene: Scene) -> np.ndarray:
        """Return starts [ROWS, 7] and goals [ROWS, 7] of the block, and the site that a tool grips, [ROWS, 1]."""
        rng, mount = np.random.default_rng(self.seed), scene.mounts[self.picker]
        pegs, others = find_pegs(scene, "peg_transfer"), [m for a, m in scene.mounts.items() if a != self.picker]
        away = lambda other: np.linalg.norm((pegs - other.position)[:, :2], axis=-1)  # noqa: E731
        pegs = pegs[np.all([away(mount) < away(other) for other in others if other.arm.jaw], axis=0)]
        sites = list(self._item.sites)
        base = self._item.sites[self.point][0]

        def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
            one, other = rng.integers(len(pegs), size=(2, ROWS))
            far = np.linalg.norm(pegs[one] - pegs[other], axis=-1)
            good = (one != other) & (far < self.level.distance)
            shift = SHIFT * np.sqrt(rng.random(ROWS))
            bearing, yaw = rng.uniform(-np.pi, np.pi, (2, ROWS))
            turn = np.stack([quaternion(turned(np.array([0.0, 0.0, np.degrees(own)]))) for own in yaw])
            place = pegs[one] - base + np.stack([shift * np.cos(bearing), shift * np.sin(bearing), 0 * yaw], -1)
            starts, goals = frames(place, turn), frames(pegs[other] - base, turn)
            number, turns = np.zeros(ROWS, int), np.full(ROWS, -np.inf)
            home = tool_of(mount, mount.arm.home)[:3, 0]
            for index, name in enumerate(sites):
                if name.startswith("grasp"):
                    along = np.abs(gripping(mount, starts, self._sites[index], 0.0)[:, :3, 0] @ home)
                    number, turns = np.where(along > turns, index, number), np.maximum(along, turns)
            for poses in (starts, goals):
                tools = gripping(mount, poses, self._sites[number], PAST)
                q, reached = joints_at(mount, tools)
                good &= reached & joints_at(mount, moved(tools, [0.0, 0.0, RAISE]), q)[1]
            rows = np.concatenate([place, turn, goals[:, :3, 3], turn, number[:, None]], -1)[good]
            return rows, np.zeros(len(rows), bool)

        return choose(scene, batch, ROWS, 0.0)


def gripping(mount: Mount, body: np.ndarray, site: np.ndarray, beyond: float) -> np.ndarray:
    """Return poses [n, 4, 4] of tools that point down at a bar of blocks at poses [n, 4, 4], a finger in the hole.

    Args:
        mount: the arm.
        body: of the blocks.
        site: middle of the bar in the block's frame, [3] or [n, 3].
        beyond: how far the tool tip is past the bar, m.
    """
    way = np.einsum("nij,nj->ni", body[:, :3, :3], np.broadcast_to(site * [1.0, 1.0, 0.0], (len(body), 3)))
    outward = way * [1.0, 1.0, 0.0] / np.linalg.norm(way[:, :2], axis=-1, keepdims=True)
    along = np.cross(np.array([0.0, 0.0, 1.0]), outward)
    along = np.where((along @ tool_of(mount, mount.arm.home)[:3, 0])[:, None] < 0, -along, along)
    place = body[:, :3, 3] + np.einsum("nij,nj->ni", body[:, :3, :3], np.broadcast_to(site, (len(body), 3)))
    return tool_poses(place + OUT * outward, along, DOWN, np.full(len(body), beyond))


def find_pegs(scene: Scene, task: str) -> np.ndarray:
    """Return where the axes of pegs meet the plate in the world, [pegs, 3], m. ValueError if there is no peg."""
    found = [
        place.position + place.rotation @ site
        for place in scene.objects.values()
        for name, (site, _) in place.object.sites.items()
        if name.startswith("peg_")
    ]
    if not found:
        raise ValueError(f"{task} needs a scene with a board that has sites peg_0, peg_1, ...; {scene.name!r} has none")
    return np.array(found)
