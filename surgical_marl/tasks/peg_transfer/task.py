"""Peg transfer: a block is lifted off its peg and put on another one, handed over above the wall on the way.

The first task of the Fundamentals of Laparoscopic Surgery, on the board of the ICRA 2026 challenge.

Agents        the arms of the scene. The first two whose jaws have pads move the block; if `easy` the first one alone.
Observation   as in `needle_handover`, but for `to_useful`; and the upper bar that is most along the tool: `to_grasp`,
              from the tool tip, and `grasp_axis`. The goal is where the middle of the block's underside should be.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best of
              the episode so far: `reach`, first tool to block (20 / m); `grasp` (2); `lift`, over 10 mm of height (2);
              if it is handed over `receive`, when both arms hold it (4), and `passed`, when the second one holds it
              alone (4); `over`, when it is held over its goal, clear of the pegs (4); `carry`, block to goal while the
              arm that places it holds it alone (20 / m). Then `precision`, exp(-error / 5 mm) while held (0.1);
              `success` (0.5); `drop` (-20); `clearance` (0), `collision` (-2).
Success       the block stands on its goal peg, less than 2 mm above the plate, and no finger touches it.
Termination   when the block, once lifted, is touched by no finger and is on no peg, or falls off the board; an episode
              is truncated after 600 control steps (12 s), if `easy` after 300.
Randomisation the block stands on any peg of the first arm's side of the wall, turned and shifted at random as far as
              the peg lets it. Its goal is a free peg of the other side, if `easy` of the same side. Kept only if the
              arms reach their grips, off their joints' limits. Arms start at home.
Difficulty    easy: one arm moves the block to one of the nearest pegs, 20 or 30 mm away. default: over the wall. hard:
              a trial of three minutes by the rules of the challenge. All blocks of the scene start on pegs of the first
              arm's side, 30 mm or more apart, and go over the wall one after the other, and then back, again and again.
              What is said above holds for the block whose turn it is: agents observe it as `object_position` and so on,
              as many numbers as at `default`, and arms have the roles of its direction. `placed` (25) is a point: the
              block stands on its goal peg in its turn, after both arms held it and then the second one alone. Then
              comes the next block, and progress is paid anew. Blocks that are moved out of turn are no points. A drop
              ends nothing; a block that falls off the board does. Success: all have been there and back. In training
              episodes start with any turn, and blocks as loose on their pegs as arms put them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grasp_poses import frames
from surgical_marl.tasks.base.object_task import NEAR, Best, Now, ObjectTask, as_float
from surgical_marl.tasks.base.object_terms import AT_HAND, PARTS, object_terms
from surgical_marl.tasks.base.oracle_script import Snapshot, Step
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.peg_transfer.blocks import OUT, find_pegs, grasp_terms, side_pegs
from surgical_marl.tasks.peg_transfer.script import SETTINGS, Transfer
from surgical_marl.tasks.peg_transfer.starts import APART, POOL, draw_moves, draw_turns, goals_in_turn
from surgical_marl.tasks.peg_transfer.trial import Trial, Turns

if TYPE_CHECKING:
    from collections.abc import Callable

    from jax import Array

    from surgical_marl.physics.outputs import ObjectView
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.terms import Picture, Term
    from surgical_marl.tasks.base.world import World

ROWS = 2048
TRIALS = 512
"""Trials that the tables at `hard` are of."""
AROUND = 0.0035
"""A block is around a peg where the axes of its hole and of the peg are nearer than this, m. Up to 2.7 mm are free."""
STANDS = 0.002
"""Greatest height of a block's underside above the plate where it stands there, m."""
SHIFT = 0.0015
"""Greatest distance of a block from its peg's axis at the start, m."""
LOOSE = 0.0026
"""Greatest distance of a block from its peg's axis at the start in training at `hard`, m: as arms put it."""
CLEAR = 0.024
"""Height of a block's underside above the plate from which on it is clear of the pegs, m: these are 20 mm high."""


class PegLevel(NamedTuple):
    """A level of difficulty."""

    distance: float
    """Greatest distance of the goal from the start, m."""
    handover: bool
    """True if the goal is on the other side of the wall."""
    trial: bool = False
    """True if all blocks are moved in turn, there and back."""
    oriented: bool = False
    """True if the goal has an orientation."""


class Team(NamedTuple):
    """The best that the arms did so far, [] float32 each."""

    receive: Array
    """1 once both arms held the lifted block, before that 0."""
    passed: Array
    """1 once the second arm alone held the block, before that 0."""
    over: Array
    """1 once the block was held over its goal, before that 0."""


class PegGoal(NamedTuple):
    """The goal of an episode, and the progress towards it."""

    row: Array
    """Row of the tables."""
    best: Best
    team: Team
    trial: Any = ()
    """State of the `Trial` so far, at `hard`."""


class Task(ObjectTask):
    """Moving a block from peg to peg."""

    levels = {"easy": PegLevel(0.032, False), "default": PegLevel(1.0, True), "hard": PegLevel(1.0, True, True)}  # noqa: RUF012
    weights = {  # noqa: RUF012
        **ObjectTask.weights, "carry": 20.0, "receive": 4.0, "passed": 4.0, "over": 4.0, "success": 0.5,
        "placed": 25.0, "drop": -20.0, "clearance": 0.0,
    }  # fmt: skip
    default_scene = "bimanual_psm_pegs"
    scenes = ("bimanual_psm_pegs", "trimanual_psm_ecm_pegs")
    hands = 2
    point = "base"
    max_steps = 600
    stages = ("reached", "grasped", "lifted", "received", "passed", "over", "at_goal")
    wanted = {"success_rate": ("at least", 0.95), "drop_rate": ("below", 0.02)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        if not self.level.handover:
            self.presenter, self.max_steps = self.picker, 300
        self._item = scene.objects[self.object].object
        self._pegs = find_pegs(scene, options.task).astype(np.float32)
        self._shift = LOOSE if self.level.trial and options.goals == "training" else SHIFT
        about = repr((self.object, self.level, self.seed, self._shift, OUT, SETTINGS, APART, POOL, TRIALS))
        content = about, scene.fingerprint, self._item.content
        self.turns: Turns | None = None
        """At `hard` whose turn it is."""
        if self.level.trial:
            self.turns, self.max_steps, self.called = Turns(scene, self.object), 9000, AT_HAND
            self._transfers = [self._transfer(name, back) for back in (False, True) for name in self.turns.blocks]
            self._set_trials(cached("peg_transfer", self._draw_trials, *content), options)
        else:
            self._transfers = [self._transfer(self.object, False)]
            table = cached("peg_transfer", self._draw, *content)
            self._set_tables(table[:, :7], frames(table[:, 7:10], table[:, 10:14]))

    def _set_trials(self, places: np.ndarray, options: Options) -> None:
        """Set the tables from where all blocks stand at the beginning of each turn, [rows, blocks * 7].

        Trials begin with the first turn. In training they begin with any turn, so that both directions are learned.
        """
        turns, rows = self.turns, np.arange(len(places))
        assert turns is not None
        each = places.reshape(len(rows), -1, 7)
        goals = goals_in_turn(each, turns, self._pegs, self._item.sites[self.point][0])
        self._set_tables(each[rows, turns.number(rows)], goals)
        first = rows if options.goals == "training" else rows - rows % turns.count
        self.tables |= {"places": places, "first": first}

    @property
    def constants(self) -> tuple[Any, ...]:
        """Constants of every object task, whether the block is handed over, and the blocks that are moved in turn."""
        return *super().constants, self.level.handover, () if self.turns is None else self.turns.blocks

    def start(self, key: Array) -> Start:
        """Return where the blocks stand, and the goal."""
        team = Team(*[jnp.float32(0.0)] * 3)
        if self.turns is None:
            row = jax.random.randint(key, (), 0, ROWS)
            place = self.tables["starts"][row]
            return Start(PegGoal(row, self.nothing, team), poses={self.object: Pose(place[:3], place[3:])})
        first = self.tables["first"]
        row = first[jax.random.randint(key, (), 0, first.shape[0])]
        own = self.tables["places"][row].reshape(-1, 7)
        poses = {name: Pose(own[i, :3], own[i, 3:]) for i, name in enumerate(self.turns.blocks)}
        return Start(PegGoal(row, self.nothing, team, Trial(*[jnp.float32(0.0)] * 4)), poses=poses)

    def advance(self, goal: Any, dt: float) -> Any:
        """Return the goal `dt` seconds later."""
        if self.turns is None:
            return goal
        return goal._replace(trial=goal.trial._replace(time=goal.trial.time + np.float32(dt)))

    # -- what is measured

    def at_hand(self, world: World) -> World:
        """Return the world in which the block whose turn it is has the name `self.object`."""
        return world if self.turns is None else self.turns.at_hand(world, self.object)

    def now(self, world: World) -> Now:
        """Return the measurements in a world; a block that is around a peg is not dropped.

        At `hard` the measurements of each arm are those of its role in this turn, and a block is dropped only once.
        """
        now = super().now(world)
        away = self._base(world)[:2] - self._pegs[:, :2]
        around = jnp.min(jnp.sum(away * away, -1)) < AROUND**2
        dropped = now.dropped & ~(around & (self._height(world) > -STANDS))
        if self.turns is None:
            return now._replace(dropped=dropped)
        dropped &= world.goal.trial.fallen <= 0
        parts: dict[str, Any] = {
            name: self.turns.roles(world.goal.row, getattr(now, name), self.picker, self.presenter)
            for name in ("reach", "part", "held", "touched")
        }
        return now._replace(dropped=dropped, **parts)

    def further(self, world: World, now: Now) -> Team:
        """Return the best that the arms did so far, with the measurements of this step."""
        team, lifted = world.goal.team, now.lift >= 1.0
        both = jnp.stack(list(now.held.values())).sum() >= 2
        alone = self.presents(now) & lifted & self.level.handover
        away = (self._base(world) - self.tables["points"][world.goal.row])[:2]
        over = self.presents(now) & (jnp.sum(away * away) < AROUND**2) & (self._height(world) > CLEAR - STANDS)
        found = (both & lifted, alone, over)
        return Team(*(jnp.maximum(best, as_float(new)) for best, new in zip(team, found, strict=True)))

    def stands(self, world: World) -> Array:
        """Return whether the block stands on its goal peg and no finger touches it, [] bool."""
        away = (self._base(world) - self.tables["points"][world.goal.row])[:2]
        arms = self.at_hand(world).arms.values()
        loose = jnp.stack([view.handles[self.object].force <= 0 for view in arms]).all()
        return loose & (jnp.sum(away * away) < AROUND**2) & (jnp.abs(self._height(world)) < STANDS)

    def placed(self, world: World) -> Array:
        """Return whether a point is made now: the block stands on its goal peg, and was handed over, [] bool."""
        team = world.goal.team
        return self.stands(world) & (team.receive > 0) & (team.passed > 0)

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far. At `hard` it becomes that of the next turn when a block is placed."""
        now = self.now(world)
        goal = super().remember(world)._replace(team=self.further(world, now))
        if self.turns is None:
            return goal
        placed, trial = self.placed(world), goal.trial
        lifted = jnp.stack(list(now.held.values())).any() & (now.lift >= 1.0)
        fallen = jnp.where(lifted | placed, 0.0, jnp.maximum(trial.fallen, as_float(now.dropped)))
        score, scored = self._score(world)
        following = PegGoal(self.turns.following(goal.row), self.nothing, Team(*[jnp.float32(0.0)] * 3), trial)
        goal = jax.tree.map(lambda new, old: jnp.where(placed, new, old), following, goal)
        goal = goal._replace(trial=Trial(score, scored, trial.time, fallen))
        return super().remember(world._replace(goal=goal))

    def _score(self, world: World) -> tuple[Array, Array]:
        """Return the points of a trial, and the time of the last one, s, with what is placed now."""
        placed, trial = self.placed(world), world.goal.trial
        return trial.score + as_float(placed), jnp.where(placed, trial.time, trial.scored)

    def terminated(self, world: World) -> Array:
        """Return whether the block has been dropped or lost; at `hard` whether any block is below the plate's top."""
        if self.turns is None:
            return super().terminated(world)
        heights = jnp.stack([world.objects[name].position[2] for name in self.turns.blocks])
        return ~(heights >= self._pegs[0, 2]).all()

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the metrics of all tasks with objects, and at `hard` `score` and `score_time`, s."""
        found = super().metrics(world)
        if self.turns is None:
            return found
        score, scored = self._score(world)
        return {agent: {**own, "score": score, "score_time": scored} for agent, own in found.items()}

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task that brings an object to a goal, `receive`, `passed`, `over` and `placed`."""
        new = self.further(world, self.now(world))
        more = {name: value - best for name, value, best in zip(Team._fields, new, world.goal.team, strict=True)}
        more["success"] = as_float(self.stands(world))
        more["placed"] = jnp.float32(0.0) if self.turns is None else as_float(self.placed(world))
        return {agent: {**terms, **more} for agent, terms in super().reward_terms(world).items()}

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the block stands on its goal peg; at `hard` whether all have been there and back."""
        done = self.stands(world) if self.turns is None else self._score(world)[0] >= self.turns.count
        return dict.fromkeys(world.arms, done)

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all arms; of one arm `received` and `passed` are those of a hold."""
        now, team = self.now(world), self.further(world, self.now(world))
        held, lifted = now.held[self.picker], now.lift >= 1.0
        found = {
            "reached": now.reach[self.picker] < NEAR,
            "grasped": held,
            "lifted": held & lifted,
            "received": (team.receive > 0) | (not self.level.handover) & held,
            "passed": (team.passed > 0) | (not self.level.handover) & held,
            "over": team.over > 0,
            "at_goal": self.stands(world),
        }
        return dict.fromkeys(world.arms, found)

    def _base(self, world: World) -> Array:
        """Return the middle of the block's underside in the world, [3], m."""
        body = self.at_hand(world).objects[self.object]
        return body.position + body.rotation @ self._point

    def _height(self, world: World) -> Array:
        """Return its height above the plate, [] m."""
        return self._base(world)[2] - self._pegs[0, 2]

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of every task with objects and of the grip; at `hard` also those of the block in turn."""

        def body(world: World) -> ObjectView:
            return self.at_hand(world).objects[self.object]

        found = {**super().terms(agent), **grasp_terms(self.scene.mounts[agent], agent, self._item, body)}
        if self.turns is None:
            return found
        own = object_terms(self.scene, agent)
        for part in PARTS:
            term = own[f"{self.object}_{part}"]
            found[f"{self.called}_{part}"] = term._replace(read=self._read_at_hand(term))
        return found

    def _read_at_hand(self, term: Term) -> Callable[[World], Array]:
        """Return a function that reads a term of the block in turn."""
        return lambda world: term.read(self.at_hand(world))

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of every such task, and after `to_object` those of the grip, if the arm has a jaw."""
        names = super().observes(agent)
        after = names.index("to_object") + 1
        grips = self.scene.mounts[agent].arm.jaw is not None
        return (*names[:after], *(("to_grasp", "grasp_axis") if grips else ()), *names[after:])

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return where the block begins and should be; at `hard` where all blocks begin, and all goals of the trial."""
        if self.turns is None:
            return super().goal_content(goal)
        points, places = (np.asarray(self.tables[name], float) for name in ("points", "places"))
        row = np.asarray(goal.row)
        every = (row - row % self.turns.count)[:, None] + np.arange(self.turns.count)
        return [places[row], points[every]]

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how the arms move the block, or at `hard` all blocks in turn.

        There each turn begins with a step that looks whose it is, so that a block that was not placed is tried again.
        """
        if self.turns is None:
            return self._transfers[0].steps()
        length = 1 + len(self._transfers[0].steps())

        def of_turn(seen: Snapshot) -> np.ndarray:
            return np.asarray(1 + length * (seen.goal.row % self.turns.count))  # type: ignore[union-attr]

        look = Step(lambda seen: {}, good=lambda seen: np.zeros(len(seen.goal.row), bool), back=of_turn)
        turns = [(*own.steps(1 + length * number), look) for number, own in enumerate(self._transfers)]
        return (look, *(step for turn in turns for step in turn))

    def _transfer(self, name: str, back: bool) -> Transfer:
        giver, taker = (self.presenter, self.picker) if back else (self.picker, self.presenter)
        return Transfer(self.scene, name, giver, taker, back, lambda seen: self.goals[seen.goal.row])

    # -- where blocks and goals are

    def _draw(self) -> np.ndarray:
        """Return starts and goals of the block, [ROWS, 14]."""
        sides = self._side(self.picker), self._side(self.presenter)
        base = self._item.sites[self.point][0]
        return draw_moves(self._transfers[0], ROWS, self.seed, sides, base, SHIFT, self.level.distance)

    def _draw_trials(self) -> np.ndarray:
        """Return where all blocks stand at the beginning of each turn, [TRIALS * turns, blocks * 7]."""
        sides, base = (self._side(self.picker), self._side(self.presenter)), self._item.sites[self.point][0]
        return draw_turns(self._transfers, TRIALS, self.seed, sides, base, self._shift)

    def _side(self, agent: str) -> np.ndarray:
        """Return the pegs [n, 3] of an arm's side that are free of blocks that stay."""
        return side_pegs(self.scene, agent, (self.object,) if self.turns is None else self.turns.blocks)
