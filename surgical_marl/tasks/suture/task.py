"""Suture: an arm drives a needle through both edges of a wound, another draws it out with its thread and hands it back.

Agents        the first two arms of the scene whose jaws have pads; the first one drives, the second is its partner.
              Others may look on.
Observation   as in `needle_drive`, and the way from the tool tip to the front third of the needle, whether another arm
              holds the needle, and how far the stitch is: the share of the needle that is out, whether all of it is,
              the length of the thread's tail at the entry, and how long that should be.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. That of `needle_drive`,
              and progress over the best of the episode so far: `meet`, from the partner's tool to the front of the
              needle that is out (20 / m), `take` as the partner holds it there (4), `draw`, the share of the needle
              that is out (6), `pull` of the tail towards its length while the partner holds the needle (40 / m), and
              `back` as the driver alone holds it again while the tail is right (6). Of each step `overload`, with more
              than 8 N on tissue (-0.1).
Success       the needle went in and came out within the tolerance of both marks, it is out of the tissue, the tail is
              within 5 mm of its length, and the driver alone holds the needle again; nothing has pressed on the tissue
              with more than 8 N, and the thread has not been pulled with more than 9.4 N. At `easy`: the partner alone
              holds the needle, and it is out of the tissue.
Termination   when the needle is neither touched by a finger nor in tissue, or falls; an episode is truncated after 900
              control steps (18 s), easy 600, hard 1100.
Randomisation as in `needle_drive`, and the length of the tail, 20 to 30 mm of a thread of 100 mm. Kept only if
              both arms can do their parts.
Difficulty    easy: the needle begins at the entry; 4 mm; without tail and handing back; default: 2.5 mm; hard: the
              needle lies on a pad and must be picked up first; 1 mm, tail within 3 mm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jnp
from surgical_marl.scenes.tissue_file import OVERLOAD
from surgical_marl.tasks.base.object_task import FAR, as_float, known
from surgical_marl.tasks.base.terms import Picture, Term
from surgical_marl.tasks.needle_drive.task import Best, Now
from surgical_marl.tasks.needle_drive.task import Task as NeedleDrive
from surgical_marl.tasks.suture.script import Stitcher

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.systems.channel_state import ChannelView
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.oracle_script import Step
    from surgical_marl.tasks.base.task import Start
    from surgical_marl.tasks.base.world import World

BACK = 0.0032, 0.0040
"""Least and greatest length of the needle between its tail and the middle of the jaw, m. Nearer to the tail the jaw's
plates would be on the thread; further away they would press on the tissue before the partner can take the tip."""
TAILS = 0.020, 0.030
"""Least and greatest length of the thread that should stay at the entry, m."""
STRENGTH = 9.4
"""Tension that a thread should not bear, N: knot-pull strength of USP size 3-0, non-absorbable."""


class SutureLevel(NamedTuple):
    """A level of difficulty."""

    edges: int
    """Edges of the wound that the needle goes through."""
    tolerance: float
    """Greatest distance of entry and exit from their marks, m."""
    out: float
    """Least length of the needle past the exit as it has been driven, m."""
    picks: bool
    """True if the needle has to be picked up first."""
    away: float
    """Share of the greatest distance and turn at which the needle in the jaw may begin."""
    tail: float
    """Greatest difference of the tail's length from what it should be, m; inf to end as the partner has the needle."""


class Stitch(NamedTuple):
    """The best of the team so far, and the greatest loads, [] float32 each."""

    meet: Array
    """Least distance of the partner's tool from the front of the needle as it was out, m; below 0 before."""
    take: Array
    """1 once the partner held the needle that was out by its front."""
    draw: Array
    """Greatest share of the needle that was out."""
    pull: Array
    """Least difference of the tail from its length while the partner held the needle, m; below 0 before."""
    back: Array
    """1 once the driver alone held the needle again while the tail was right."""
    force: Array
    """The largest force on the tissue, N."""
    tension: Array
    """The largest tension of the thread, N."""


class SutureGoal(NamedTuple):
    """The goal of an episode, and the progress towards it."""

    row: Array
    """Row of the tables."""
    best: Best
    stitch: Stitch
    tail: Array
    """Length of the thread that has not gone in at the entry, m."""


class Sewn(NamedTuple):
    """Measurements of a stitch in a world, [] each."""

    meet: Array
    """Distance of the partner's tool from the front of the needle, m."""
    partner: Array
    """True if the partner holds the needle."""
    alone: Array
    """True if the partner holds it, and the driver does not touch it."""
    returned: Array
    """True if the driver holds it, and the partner does not touch it."""
    out: Array
    """True if the needle has left the tissue at the exit, and its thread goes through."""
    tail: Array
    """Length of thread that has not gone in at the entry, m."""
    gap: Array
    """Distance of both edges from each other between the marks, on the upper face, m."""


class Task(NeedleDrive):
    """One stitch by two arms."""

    levels = {  # noqa: RUF012
        "easy": SutureLevel(2, 0.004, 0.003, False, 0.0, np.inf),
        "default": SutureLevel(2, 0.0025, 0.003, False, 1.0, 0.005),
        "hard": SutureLevel(2, 0.001, 0.003, True, 1.0, 0.003),
    }
    weights = {  # noqa: RUF012
        **NeedleDrive.weights, "meet": 20.0, "take": 4.0, "draw": 6.0, "pull": 40.0, "back": 6.0, "overload": -0.1,
    }  # fmt: skip
    default_scene = "bimanual_psm_suture"
    scenes = ("bimanual_psm_suture",)
    stages = ("entered", "first_edge", "exited", "taken", "drawn", "pulled", "handed_back")
    wanted = {"success_rate": ("at least", 0.9), "drop_rate": ("below", 0.05)}  # noqa: RUF012
    lean, beyond = np.radians(10.0), np.radians(40.0)

    def __init__(self, scene: Scene, options: Options) -> None:
        self.partner = self._find_partner(scene, options)
        """The second arm whose jaw has pads."""
        super().__init__(scene, options)
        self.max_steps = 900 + 200 * self.level.picks if self.whole else 600
        self.thread, self._length = self._find_thread(scene, options)
        front = len(self._middles) - len(self._middles) // 3
        self._front = self._middles[front:]  # bars go from the tail to the tip
        rng, rows = np.random.default_rng(self.seed), len(self.sweep)
        at = self.tables["marks"][..., 0].mean(-1)
        rims = self.wound.middle + self.wound.width * np.stack([-self.wound.across, self.wound.across])
        rims = np.tile(rims, (rows, 1, 1))
        rims[..., 0] = at[:, None]
        self.tables |= {"tails": rng.uniform(*TAILS, rows), "rims": rims}

    @property
    def whole(self) -> bool:
        """True if the thread is pulled and the needle handed back."""
        return bool(np.isfinite(self.level.tail))

    @property
    def constants(self) -> tuple[Any, ...]:
        """Those of `needle_drive`, the partner and the thread."""
        return *super().constants, self.partner, self.thread, self._length

    def _find_partner(self, scene: Scene, options: Options) -> str:
        """Return the second arm whose jaw has pads; ValueError if there is none."""
        holders = scene.holders
        if len(holders) < 2:
            raise ValueError(
                f"{label(options.task)} needs two arms whose jaws have pads; {scene.name!r} has {len(holders)} (choose "
                f"from {', '.join(self.scenes)}, or a file)"
            )
        return holders[1]

    def _find_thread(self, scene: Scene, options: Options) -> tuple[str, float]:
        """Return the name and the length of the thread that is tied to the needle, m; ValueError if there is none."""
        for name, system in scene.systems.items():
            if any(tie.body == self.object for tie in system.ties):
                return name, float(system.length)
        raise ValueError(
            f"{label(options.task)} needs a thread that is tied to {self.object!r}; {scene.name!r} has none"
        )

    def _draw(self, scene: Scene, **more: Any) -> np.ndarray:
        """Return starts from which the partner can do its part, too."""
        stitcher = Stitcher(scene, self.driver, self.partner, self.object, self.needle, self.beyond)
        return super()._draw(scene, back=BACK, away=self.level.away, also=stitcher.can_be_taken)

    def start(self, key: Array) -> Start:
        """Return where arms and needle begin, and the marks."""
        first, zero, before = super().start(key), jnp.float32(0.0), jnp.float32(-1.0)
        stitch = Stitch(before, zero, zero, before, zero, zero, zero)
        return first._replace(goal=SutureGoal(first.goal.row, first.goal.best, stitch, jnp.float32(self._length)))

    # -- what is measured

    def bites(self, channels: ChannelView) -> Array:
        """Return which channels count as bites of the needle, [c] bool: those that it or its thread is in."""
        return channels.there & ((channels.needle == self._mine) | (channels.thread == self._mine))

    def sewn(self, world: World) -> Sewn:
        """Return the measurements of the stitch in a world."""
        body, view, row = world.objects[self.object], world.systems[self.tissue], world.goal.row
        channels, mount = view.channels, self.scene.mounts[self.partner]
        driver, partner = (world.arms[agent].handles[self.object] for agent in (self.driver, self.partner))
        away = world.arms[self.partner].tool_tip @ mount.rotation.T.astype(np.float32)
        away += mount.position.astype(np.float32) - body.position
        off = body.size * self._front @ body.rotation.T - away
        needle_in = (channels.there & (channels.needle == self._mine)).any()
        threaded = (channels.there & (channels.thread == self._mine) & channels.through).any()
        drawn = jnp.max(jnp.where(self.bites(channels), channels.drawn, 0.0))
        material = self._system.channels.material
        rims = [material.place(view.position, self.tables["rims"][row][i] / material.cell) for i in range(2)]
        return Sewn(
            meet=known(jnp.sqrt(jnp.min(jnp.sum(off * off, -1)))),
            partner=partner.holding,
            alone=partner.holding & ~(driver.force > 0),
            returned=driver.holding & ~(partner.force > 0),
            out=threaded & ~needle_in,
            tail=self._length - drawn,
            gap=jnp.sqrt(jnp.sum((rims[1] - rims[0]) ** 2)),
        )

    def further(self, world: World, now: Now, sewn: Sewn) -> Stitch:
        """Return the best of the team so far, with the measurements of this step."""
        stitch, good = world.goal.stitch, self._good(now)
        ready = good & (now.out >= self.level.out)

        def least(value: Array, before: Array, counts: Array) -> Array:
            return jnp.where(counts, jnp.where(before < 0, value, jnp.minimum(value, before)), before)

        share = jnp.where(sewn.out, 1.0, now.out / self.needle.length)
        return Stitch(
            least(sewn.meet, stitch.meet, ready & ~sewn.out),
            jnp.maximum(stitch.take, as_float(sewn.partner & ready)),
            jnp.where(good, jnp.maximum(stitch.draw, share), stitch.draw),
            least(known(self._off(world, sewn)), stitch.pull, good & sewn.out & sewn.partner),
            jnp.maximum(stitch.back, as_float(self._right(world, now, sewn) & sewn.returned)),
            jnp.maximum(stitch.force, world.systems[self.tissue].tissue_force),
            jnp.maximum(stitch.tension, jnp.max(world.systems[self.thread].tension)),
        )

    def _good(self, now: Now) -> Array:
        """Return whether the needle went in and came out within the tolerance."""
        return now.entered & (now.entry < self.level.tolerance) & now.came_out

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far."""
        sewn = self.sewn(world)
        return super().remember(world)._replace(stitch=self.further(world, self.now(world), sewn), tail=sewn.tail)

    def _off(self, world: World, sewn: Sewn) -> Array:
        """Return by how much the tail's length is off, m."""
        return jnp.abs(sewn.tail - self.tables["tails"][world.goal.row])

    def _right(self, world: World, now: Now, sewn: Sewn) -> Array:
        """Return whether a stitch within the tolerance has a tail within its own."""
        return self._good(now) & sewn.out & (self._off(world, sewn) < self.level.tail)

    def _done(self, world: World, now: Now, sewn: Sewn) -> Array:
        """Return whether the stitch is done, and neither tissue nor thread was overloaded."""
        stitch = self.further(world, now, sewn)
        unhurt = (stitch.force <= OVERLOAD) & (stitch.tension <= STRENGTH) & ~world.systems[self.thread].broken
        held = sewn.returned if self.whole else sewn.alone
        return self._right(world, now, sewn) & held & unhurt

    # -- what agents get

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of `needle_drive`, and the progress of the stitch."""
        now, sewn, stitch = self.now(world), self.sewn(world), world.goal.stitch
        new = self.further(world, now, sewn)

        def nearer(before: Array, after: Array) -> Array:
            return jnp.where(before < 0, 0.0, before - after)

        more = {
            "meet": nearer(stitch.meet, new.meet),
            "take": new.take - stitch.take,
            "draw": new.draw - stitch.draw,
            "pull": nearer(stitch.pull, new.pull),
            "back": new.back - stitch.back,
            "overload": as_float(world.systems[self.tissue].tissue_force > OVERLOAD),
            "success": as_float(self._done(world, now, sewn)),
        }
        return {agent: {**terms, **more} for agent, terms in super().reward_terms(world).items()}

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the stitch is done, for all agents."""
        return dict.fromkeys(world.arms, self._done(world, self.now(world), self.sewn(world)))

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all arms."""
        now, sewn = self.now(world), self.sewn(world)
        entered, good, right = (
            now.entered & (now.entry < self.level.tolerance),
            self._good(now),
            self._right(world, now, sewn),
        )
        found = {
            "entered": entered,
            "first_edge": entered & now.edge,
            "exited": good,
            "taken": good & sewn.partner,
            "drawn": good & sewn.out & sewn.alone,
            "pulled": right & sewn.partner,
            "handed_back": right & sewn.returned,
        }
        return dict.fromkeys(world.arms, found)

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return those of `needle_drive`, `tail_error` and `gap`, m."""
        sewn = self.sewn(world)
        more = {"tail_error": self._off(world, sewn), "gap": sewn.gap}
        return {agent: {**found, **more} for agent, found in super().metrics(world).items()}

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of `needle_drive`, and those of the stitch.

        `to_front` [3] from the tool tip to the nearest bar of the needle's front third, in the base frame; `stitch`
        [3]: share of the needle past the exit, whether all of it is out, and length of the tail, m; `tail` [1], how
        long that should be; `others_hold` [1], whether another arm holds the needle.
        """
        mount = self.scene.mounts[agent]
        turn, origin = mount.rotation.astype(np.float32), mount.position.astype(np.float32)

        def to_front(world: World) -> Array:
            body = world.objects[self.object]
            away = (body.position + body.size * self._front @ body.rotation.T - origin) @ turn
            away -= world.arms[agent].tool_tip
            return away[jnp.argmin(jnp.sum(away * away, -1))]

        def stitch(world: World) -> Array:
            now, sewn = self.now(world), self.sewn(world)
            share = jnp.where(sewn.out, 1.0, now.out / self.needle.length)
            return jnp.stack([share, as_float(sewn.out), sewn.tail])

        def others_hold(world: World) -> Array:
            held = [view.handles[self.object].holding for other, view in world.arms.items() if other != agent]
            return as_float(jnp.stack(held).any())[None]

        far, one = np.full(3, FAR), np.ones(1)
        return {
            **super().terms(agent),
            "to_front": Term(to_front, -far, far, "object"),
            "stitch": Term(stitch, np.zeros(3), np.array([1.0, 1.0, self._length]), "object"),
            "tail": Term(
                lambda world: self.tables["tails"][world.goal.row][None], 0 * one, TAILS[1] * one, "team_goal"
            ),
            "others_hold": Term(others_hold, 0 * one, one, "others"),
        }

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of `needle_drive`, and those of the stitch after `through`."""
        names = super().observes(agent)
        after = names.index("through") + 1
        return (*names[:after], "to_front", "stitch", "tail", "others_hold", *names[after:])

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return where the needle begins, the marks, and how long the tail should be."""
        return [*super().goal_content(goal), np.asarray(self.tables["tails"], float)[goal.row]]

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how both arms do it: the drive, then the partner takes, draws and pulls, and hands the needle back."""
        drive = super().script()
        stitcher = Stitcher(self.scene, self.driver, self.partner, self.object, self.needle, self.beyond)
        return (*drive, *stitcher.script(self, len(drive)))
