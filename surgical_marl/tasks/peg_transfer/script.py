"""The oracle's script of peg transfer: how arms bring a block from peg to peg, and where they hand it over."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from surgical_marl.tasks.base.grasp_poses import joints_at, moved, tool_of
from surgical_marl.tasks.base.oracle_script import EARLY, Snapshot, Step, Wish
from surgical_marl.tasks.peg_transfer.blocks import gripping, upright

if TYPE_CHECKING:
    from surgical_marl.scenes.scene import Mount, Scene

ABOVE_WALL = 0.09
"""Height of the block's middle in the exchange, m in the world: its underside is 12 mm above the wall."""
PAST, WIDE = 0.0025, 0.45
"""Distance by which the oracle's tool tip goes past the bar, m, and share by which its jaw opens: one finger goes
between bar and peg."""
OVER, RAISE, AWAY = 0.012, 0.030, 0.035
"""Height at which the tool tip stops above the bar, height by which it lifts the block, and distance from the wall
before and after the exchange, m."""
SIDE, NEXT = 150.0, -120.0
"""Bearing from the block's axis of the bar that a tool of the left grips in the exchange, degrees about z, and the turn
from there to the bar that a tool of the right grips, the next one clockwise, at 30 degrees."""
THERE = 0.004
"""Largest distance of the block's middle from the place of the exchange when the oracle's taker comes, m."""
SETTINGS = (ABOVE_WALL, PAST, WIDE, OVER, RAISE, AWAY, SIDE, NEXT)


class Transfer:
    """Script of one block: an arm lifts it off its peg, and it, or an arm that takes it above the wall, places it.

    Args:
        scene: the arms and the block.
        name: of the block.
        giver: the arm that lifts it.
        taker: the arm that places it, which may be the same one.
        back: whether the giver is on the right side of the wall and the taker on the left, seen along y.
        goals: where the block should be in the environments of a snapshot, [n, 4, 4].
    """

    def __init__(
        self, scene: Scene, name: str, giver: str, taker: str, back: bool, goals: Callable[[Snapshot], np.ndarray]
    ) -> None:
        item = scene.objects[name].object
        self.scene, self.name, self.giver, self.taker, self._goals = scene, name, giver, taker, goals
        self._number = list(scene.free_objects).index(name)
        self.sites = np.array([place for site, (place, _) in item.sites.items() if site.startswith("grasp_")])
        """Middles of the bars that a jaw grips, [bars, 3], counter-clockwise, in the block's frame, m."""
        self._side, self._step = (SIDE + NEXT, 1) if back else (SIDE, -1)

    # -- geometry

    def aligned(self, block: np.ndarray) -> np.ndarray:
        """Return the number [n] of the bar of blocks at poses [n, 4, 4] for which the giver turns least from home."""
        mount = self.scene.mounts[self.giver]
        home = tool_of(mount, mount.arm.home)[:3, 0]
        along = [np.abs(gripping(mount, block, site, 0.0)[:, :3, 0] @ home) for site in self.sites]
        return np.argmax(along, 0)

    def exchange(self, number: np.ndarray) -> np.ndarray:
        """Return poses [n, 4, 4] of the block in the exchange, of which the giver holds the bars `number` [n]."""
        site = self.sites[number]
        return upright(np.tile(self.place, (len(site), 1)), self._side - np.degrees(np.arctan2(site[:, 1], site[:, 0])))

    def taken(self, number: np.ndarray) -> np.ndarray:
        """Return the bars [n] that the taker grips, if the giver grips `number` [n]."""
        return np.asarray((number + self._step) % len(self.sites))

    @cached_property
    def place(self) -> np.ndarray:
        """Place of the block's middle in the exchange, [3], m."""
        first, second = (self.scene.mounts[agent].position for agent in (self.giver, self.taker))
        return np.array([*((first + second) / 2)[:2], ABOVE_WALL])

    @cached_property
    def across(self) -> np.ndarray:
        """The horizontal direction from the giver to the taker, [3]."""
        way = self.scene.mounts[self.taker].position - self.scene.mounts[self.giver].position
        way = way * [1.0, 1.0, 0.0]
        return np.asarray(way / np.linalg.norm(way))

    def reaches(self, agent: str, block: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Return whether an arm reaches bars [n] of blocks at poses [n, 4, 4], and `RAISE` / 2 above, [n] bool."""
        mount: Mount = self.scene.mounts[agent]
        tools = gripping(mount, block, self.sites[number], PAST)
        q, good = joints_at(mount, tools)
        return np.asarray(good & joints_at(mount, moved(tools, [0.0, 0.0, RAISE / 2]), q)[1])

    def possible(self, block: np.ndarray) -> np.ndarray:
        """Return whether both arms reach their grips if blocks begin at poses [n, 4, 4], [n] bool."""
        number = self.aligned(block)
        there = self.exchange(number)
        good = self.reaches(self.giver, block, number) & self.reaches(self.giver, there, number)
        return good & self.reaches(self.taker, there, self.taken(number))

    # -- the oracle

    def steps(self, first: int = 0) -> tuple[Step, ...]:
        """Return how the arms do it: lift the block, hand it over above the wall if needed, lower it on the peg.

        Args:
            first: the number of the first step in the whole script.
        """
        lift = self._lift(first)
        return (*lift, *(self._pass_on(first, first + len(lift)) if self.giver != self.taker else ()), *self._lower())

    def _lift(self, first: int) -> tuple[Step, ...]:
        """Return how the giver lifts the block off its peg."""
        agent, holds = self.giver, self._holds(self.giver)

        def grip(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            return self._grip(seen, agent, self.aligned(seen.objects[self.name]), beyond)

        return (
            # From home, so that turns do not add up from block to block.
            Step(lambda seen: {agent: grip(seen, -OVER)[agent]._replace(from_home=True)}, wait=0.1),
            Step(lambda seen: grip(seen, PAST), wait=0.1, pace=0.3),
            Step(lambda seen: {agent: Wish()}, wait=0.4, pace=0.3, good=holds, back=first),
            Step(lambda seen: _shifted(seen, agent, [0, 0, RAISE / 2]), pace=0.3, good=holds, back=first),
            Step(lambda seen: _shifted(seen, agent, [0, 0, RAISE / 2]), wait=0.1, pace=0.4),
        )

    def _pass_on(self, first: int, offered: int) -> tuple[Step, ...]:
        """Return how the giver hands the block over above the wall, and the taker brings it aside.

        Args:
            first: number of the script's step that begins to lift the block, for when the giver has lost it.
            offered: number of the first of these steps.
        """
        giver, taker, across = self.giver, self.taker, self.across

        def offer(seen: Snapshot, way: ArrayLike) -> dict[str, Wish]:
            grip = self._held_at(seen)
            there = self.exchange(grip)
            held = np.linalg.inv(seen.objects[self.name]) @ seen.tools[giver]
            taken = gripping(self.scene.mounts[taker], there, self.sites[self.taken(grip)], 0.0)
            waits = moved(taken, AWAY * across + [0.0, 0.0, OVER])
            waiting = Wish(waits, WIDE, from_home=True)
            return {giver: Wish(moved(there, way) @ held), taker: waiting}

        def take(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            return self._grip(seen, taker, self.taken(self._held_at(seen)), beyond)

        def offered_there(seen: Snapshot) -> np.ndarray:
            """Return whether the block is there: a giver with a policy of its own takes its own time."""
            return np.asarray(np.linalg.norm(seen.objects[self.name][:, :3, 3] - self.place, axis=-1) < THERE)

        def left(seen: Snapshot) -> np.ndarray:
            """Return whether the giver is out of the taker's way."""
            return np.asarray((seen.tools[taker] - seen.tools[giver])[:, :3, 3] @ across > AWAY)

        def again(seen: Snapshot) -> np.ndarray:
            return np.where(self._holds(giver)(seen), offered + 2, first)

        return (
            Step(lambda seen: offer(seen, [0.0, 0.0, 0.01] - AWAY * across), pace=0.6),
            Step(lambda seen: offer(seen, [0.0, 0.0, 0.0]), wait=0.2, pace=0.5, good=offered_there, back=offered + 1),
            Step(lambda seen: take(seen, -OVER), wait=0.1, pace=0.6),
            Step(lambda seen: take(seen, PAST), wait=EARLY, pace=0.3),
            Step(lambda seen: {taker: Wish()}, wait=0.4, pace=0.3, good=self._holds(taker), back=again),
            Step(lambda seen: {giver: Wish(opens=WIDE)}, wait=0.2),
            Step(lambda seen: _shifted(seen, giver, [0, 0, RAISE / 2], WIDE), pace=0.3),
            Step(lambda seen: _shifted(seen, giver, -AWAY * across, WIDE), pace=0.6, good=left, back=offered + 7),
            Step(lambda seen: self._carry(seen, self.place + AWAY * across), pace=0.5),
        )

    def _lower(self) -> tuple[Step, ...]:
        """Return how the taker puts the block on the peg of its goal, and lets go."""
        agent = self.taker

        def over(seen: Snapshot, height: float) -> np.ndarray:
            return self._goals(seen)[:, :3, 3] + np.array([0.0, 0.0, height])

        return (
            Step(lambda seen: self._carry(seen, over(seen, RAISE)), wait=0.1, pace=0.5),
            Step(lambda seen: self._carry(seen, over(seen, RAISE / 2)), pace=0.3),
            Step(lambda seen: self._carry(seen, over(seen, 0.0005)), wait=0.1, pace=0.3),
            Step(lambda seen: {agent: Wish(opens=WIDE)}, wait=0.2),
            Step(lambda seen: _shifted(seen, agent, [0, 0, RAISE / 2], WIDE), pace=0.3),
            Step(lambda seen: {agent: Wish(opens=WIDE)}),
        )

    def _holds(self, agent: str) -> Callable[[Snapshot], np.ndarray]:
        return lambda seen: seen.held[agent][:, self._number]

    def _held_at(self, seen: Snapshot) -> np.ndarray:
        """Return the bar [n] that is nearest to the giver's tool."""
        tool = (np.linalg.inv(seen.objects[self.name]) @ seen.tools[self.giver])[:, :3, 3]
        return np.asarray(np.linalg.norm(tool[:, None] - self.sites, axis=-1).argmin(1))

    def _grip(self, seen: Snapshot, agent: str, number: np.ndarray, beyond: float) -> dict[str, Wish]:
        tool = gripping(self.scene.mounts[agent], seen.objects[self.name], self.sites[number], beyond)
        return {agent: Wish(tool, opens=WIDE)}

    def _carry(self, seen: Snapshot, place: np.ndarray) -> dict[str, Wish]:
        """Return the wish that the held block is upright at a place [n, 3], turned so that the tool turns least."""
        agent = self.taker
        held = np.linalg.inv(seen.objects[self.name]) @ seen.tools[agent]
        home = tool_of(self.scene.mounts[agent], self.scene.mounts[agent].arm.home)[:3, 0]
        yaw = np.arctan2(home[1], home[0]) - np.arctan2(held[:, 1, 0], held[:, 0, 0])
        if agent == self.giver:  # nothing turns it on the way
            yaw = np.arctan2(self._goals(seen)[:, 1, 0], self._goals(seen)[:, 0, 0])
        return {agent: Wish(upright(np.broadcast_to(place, (len(held), 3)), np.degrees(yaw)) @ held)}


def _shifted(seen: Snapshot, agent: str, way: ArrayLike, opens: float = 0.0) -> dict[str, Wish]:
    """Return the wish that a tool goes some way in the world, [3], m."""
    return {agent: Wish(moved(seen.tools[agent], way), opens)}
