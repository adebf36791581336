"""Peg transfer at `hard`: whose turn it is, what is a point, what ends a trial, and the oracle."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from surgical_marl.content import content_dir
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.physics.outputs import Handled, ObjectView
from surgical_marl.policies.policy import load_policy
from surgical_marl.scenes.object_contacts import RESTING, distances
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.peg_transfer.starts import APART
from surgical_marl.tasks.peg_transfer.task import LOOSE

TASK, SCENE = "peg_transfer", "bimanual_psm_pegs"
BLUE, RED = "block_blue", "block_red"
FIRST, SECOND, BOTH, NONE = {"psm_0"}, {"psm_1"}, {"psm_0", "psm_1"}, set[str]()
HIGH = np.array([0.0, 0.0, 0.05])
"""From a block that stands on the plate to one that is clear of the pegs, m."""

DIGITS = (
    ".physics.arms.qpos",
    *(f".physics.rigid_bodies.bodies.{part}" for part in ("position", "quaternion", "velocity")),
)

FORCE = 0.1
"""What 0.1 um, some units in the last place of a coordinate, are worth in a contact of 1e6 N/m, N."""


@cache
def env(goals: str = "held_out") -> Env:
    return Env(TASK, SCENE, difficulty="hard", goals=goals)


@cache
def task() -> Any:
    return env().task


class Played:
    """A trial that is played by putting blocks where they should be, without physics."""

    def __init__(self, row: int = 0) -> None:
        places = task().tables["places"].reshape(-1, 2, 7)[row]
        self.places = {name: place[:3].copy() for name, place in zip((BLUE, RED), places, strict=True)}
        start = task().start(jax.random.PRNGKey(0)).goal
        self.goal = start._replace(row=np.int32(row))
        self.goal = task().remember(self.world()._replace(goal=self.goal))

    def world(self, block: str = BLUE, held: set[str] = NONE) -> World:
        """Return the world where some arms hold a block, and no arm touches the other one."""
        arms: dict[str, Any] = {}
        for agent, mount in task().scene.mounts.items():
            on = {}
            for name in self.places:
                holds: Any = np.bool_(agent in held and name == block)
                on[name] = Handled(holds.astype(np.float32), holds, holds.astype(np.float32))
            arms[agent] = SimpleView(
                tool_tip=np.asarray((self.places[block] - mount.position) @ mount.rotation, np.float32), handles=on,
                min_distance=np.float32(0.05), collision=np.bool_(False),
            )  # fmt: skip
        bodies: Any = {
            name: ObjectView(np.float32(place), np.eye(3, dtype=np.float32), np.zeros(6))  # type: ignore[arg-type]
            for name, place in self.places.items()
        }
        return World(arms, task().advance(self.goal, 1.0), objects=bodies)

    def step(self, block: str, place: Any, held: set[str] = NONE) -> dict[str, float]:
        """Put a block somewhere for a second, and return the reward terms, the metrics and whether the trial ends."""
        self.places[block] = np.asarray(place, float)
        world = self.world(block, held)
        told = {**task().reward_terms(world)["psm_0"], **task().metrics(world)["psm_0"],
                "over": task().terminated(world), "success": task().success(world)["psm_0"]}  # fmt: skip
        self.goal = task().remember(world)
        return {name: float(value) for name, value in told.items()}

    def peg(self, row: int | None = None) -> np.ndarray:
        """Return where the middle of a block is that stands on the goal peg of a turn, by default the present one."""
        return np.asarray(task().tables["points"][int(self.goal.row) if row is None else row] + [0.0, 0.0, 0.0075])

    def bring(self, block: str, place: Any, giver: set[str] = FIRST, taker: set[str] = SECOND) -> dict[str, float]:
        """Hand a block over and put it somewhere."""
        for held in (giver, BOTH, taker):
            self.step(block, np.asarray(place) + HIGH, held)
        return self.step(block, place)


class SimpleView(SimpleNamespace):
    """What tasks read of an arm."""

    def _replace(self, **values: Any) -> SimpleView:
        return SimpleView(**{**vars(self), **values})


def test_blocks_begin_on_the_left_and_go_there_and_back_in_turn() -> None:
    tables, turns = task().tables, task().turns
    assert turns.blocks == (BLUE, RED) and turns.count == 4
    places = tables["places"].reshape(-1, 4, 2, 7)
    sides = np.sign(places[..., 0])
    np.testing.assert_array_equal(sides, np.tile([[-1, -1], [1, -1], [1, 1], [-1, 1]], (len(sides), 1, 1)))
    goals = tables["points"].reshape(-1, 4, 3)
    for turn in range(4):
        after = places[:, (turn + 1) % 4, turn % 2, :2]
        assert np.linalg.norm(after - goals[:, turn, :2], axis=-1).max() < LOOSE + 1e-6
    for side in (0, 2):
        assert np.linalg.norm(goals[:, side] - goals[:, side + 1], axis=-1).min() >= APART
    assert len(np.unique(goals[:, :2].reshape(-1, 3), axis=0)) == 9
    some = tables["places"].reshape(-1, 2, 7)[::16]
    poses = {name: Pose(some[:, i, :3], some[:, i, 3:]) for i, name in enumerate(turns.blocks)}
    assert (distances(task().scene, poses).min(1) > -RESTING).all()


def test_evaluations_begin_with_the_first_turn_and_training_with_any() -> None:
    keys, starts = jax.random.split(jax.random.PRNGKey(0), 64), {}
    for goals in ("held_out", "training"):
        own = env(goals).task.bound({}, jax.tree.map(jax.numpy.asarray, env(goals).parameters["tables"]))
        starts[goals] = jax.vmap(own.start)(keys)
    turn = {goals: set((np.asarray(start.goal.row) % 4).tolist()) for goals, start in starts.items()}
    assert turn == {"held_out": {0}, "training": {0, 1, 2, 3}}
    assert (np.asarray(starts["held_out"].poses[RED].position)[:, 0] < 0).all()
    own, other = (env(goals).task.tables["places"] for goals in ("held_out", "training"))
    assert not {row.tobytes() for row in own} & {row.tobytes() for row in other}


def test_one_kernel_serves_training_and_evaluation() -> None:
    assert env().content == env("training").content != Env(TASK, SCENE).content


def test_agents_observe_the_block_whose_turn_it_is() -> None:
    """As many numbers as at `default`, in the same order, so that one policy plays both."""
    other = Env(TASK, SCENE)
    for agent in env().agents:
        names = [name.replace("object_", f"{BLUE}_") for name in env().observed[agent].names]
        assert tuple(names) == other.observed[agent].names
    played = Played()
    for row, block in enumerate((BLUE, RED, BLUE, RED)):
        terms, world = task().terms("psm_1"), played.world()
        seen = terms["object_position"].read(world._replace(goal=played.goal._replace(row=row)))
        own = terms[f"{block}_position"].read(world)
        np.testing.assert_allclose(seen, own, atol=1e-7)  # the same to rounding, which depends on the processor


def test_a_block_that_is_handed_over_and_placed_is_a_point_and_the_next_one_follows() -> None:
    played, told = Played(), {}
    for turn, block in enumerate((BLUE, RED, BLUE, RED, BLUE)):
        assert played.goal.row == turn % 4
        giver, taker = (FIRST, SECOND) if turn % 4 < 2 else (SECOND, FIRST)
        told = played.bring(block, played.peg(), giver, taker)
        assert told["placed"] == 1.0 and told["score"] == turn + 1
        assert told["success"] == (turn >= 3) and told["over"] == 0
        assert told["score_time"] == 4 * turn + 4  # each takes four steps of a second
        assert max(played.goal.team) == 0.0 and played.goal.best.lift == 0.0
    waiting = played.step(BLUE, played.places[BLUE])
    assert waiting["placed"] == 0.0 and waiting["score"] == 5 and waiting["score_time"] == told["score_time"]


def test_progress_is_paid_anew_for_each_block_in_the_roles_of_its_turn() -> None:
    played = Played()
    played.bring(BLUE, played.peg())
    played.bring(RED, played.peg())
    high = played.peg() + HIGH
    assert played.step(BLUE, played.places[BLUE], FIRST)["grasp"] == 0.0  # on its way back the second arm picks it up
    back = played.step(BLUE, high, SECOND)
    assert back["grasp"] == 1.0 and back["passed"] == 0.0
    assert played.step(BLUE, high, BOTH)["receive"] == 1.0
    assert played.step(BLUE, high, FIRST)["passed"] == 1.0


def test_a_block_that_is_moved_out_of_order_is_no_point() -> None:
    played = Played()
    out = played.bring(RED, played.peg(1))  # it is the blue block's turn
    assert out["score"] == 0 and played.goal.row == 0
    played.bring(BLUE, played.peg())
    waiting = played.step(RED, played.places[RED])
    assert played.goal.row == 1 and waiting["score"] == 1  # it stands there, but was not handed over in its turn
    assert played.bring(RED, played.places[RED])["score"] == 2


def test_a_block_that_was_not_handed_over_is_no_point() -> None:
    played = Played()
    played.step(BLUE, played.peg() + HIGH, SECOND)
    assert played.step(BLUE, played.peg())["score"] == 0


def test_a_drop_is_counted_once_and_does_not_end_the_trial() -> None:
    played = Played()
    aside = np.array([-0.02, -0.04, played.peg()[2]])
    played.step(BLUE, aside + HIGH, FIRST)
    told = [played.step(BLUE, aside) for _ in range(3)]
    assert [one["drop"] for one in told] == [1.0, 0.0, 0.0] and not any(one["over"] for one in told)
    assert played.step(BLUE, aside, FIRST)["drop"] == played.step(BLUE, aside)["drop"] == 0.0
    played.step(BLUE, aside + HIGH, FIRST)
    assert played.step(BLUE, aside)["drop"] == 1.0
    assert played.bring(BLUE, played.peg())["score"] == 1


@pytest.mark.parametrize("block", [BLUE, RED])
def test_a_block_that_falls_off_the_board_ends_the_trial(block: str) -> None:
    played = Played()
    assert played.step(block, [-0.12, 0.0, -0.03 + 0.006], FIRST)["over"] == 0.0
    assert played.step(block, [-0.12, 0.0, -0.03 - 0.0065])["over"] == 1.0


def test_six_blocks_stand_on_the_outer_columns_and_more_than_pegs_allow_are_refused(tmp_path: Path) -> None:
    own: Any = Env(TASK, "bimanual_psm_pegs_fls", difficulty="hard").task
    places = own.tables["places"].reshape(-1, 12, 6, 7)
    assert own.turns.count == 12 and (places[:, 0, :, 0] < 0).all() and (places[:, 6, :, 0] > 0).all()
    columns = np.abs(places[..., 0])
    assert ((np.abs(columns - 0.04) < LOOSE + 1e-6) | (np.abs(columns - 0.08) < LOOSE + 1e-6)).all()
    seven = tmp_path / "seven.yaml"
    more = "  block_white: {object: block, position: [-0.06, 0.0, 0.0]}\n"
    seven.write_text(
        (content_dir("scenes") / "bimanual_psm_pegs_fls.yaml").read_text().replace("view:", f"{more}view:")
    )
    with pytest.raises(ValueError, match="a trial of 7 blocks needs as many pegs 30 mm apart"):
        Env(TASK, str(seven), difficulty="hard")


@pytest.mark.slow
def test_both_engines_play_the_same_trial() -> None:
    """A step of each from states along the oracle's transfers: what is counted is the same, and what is observed is as
    near as the reference is to itself when the last digits of joints and blocks change."""
    many = BatchedEnv(TASK, SCENE, num_envs=16, difficulty="hard", engine="fused", device="cpu")
    acting, reference = load_policy("oracle", many), make_engine(many.env, 16, "mjx", "cpu")
    seen, placed, far = many.reset(0)[0], 0.0, []
    reference.reset(0)

    def expected(carry: dict[str, np.ndarray], actions: dict[str, Any], way: float) -> Any:
        for name, value in carry.items():
            changed = way and name in DIGITS
            reference.write(name, np.nextafter(value, np.float32(way)) if changed else value)
        reference.step({agent: np.float32(np.clip(action, -1, 1)) for agent, action in actions.items()})
        return jax.tree.map(np.array, reference.outcome("numpy"))

    for number in range(420):
        actions = acting(seen)
        outcomes = [expected(many.carry(), actions, way) for way in (0, -9, 9)] if number % 20 == 0 else []
        step = many.step(actions)
        if outcomes:
            for agent in many.agents:
                found, (same, *others) = step.observations[agent], [own["observations"][agent] for own in outcomes]
                response = np.max([np.abs(other - same).max(0) for other in others], 0)
                allowed = 1e-4 * (np.abs(same).max(0) + 0.1) + 10 * response
                for term in ("contact_force", "object_grip"):
                    allowed[many.observation_terms(agent)[term].start] += FORCE
                far.append(np.abs(found - same) > allowed)
                for name in ("success", "score", "score_time", "drop", "stage_passed", "reward_placed"):
                    np.testing.assert_array_equal(outcomes[0]["infos"][agent][name], step.infos[agent][name], name)
        seen, placed = step.observations, placed + step.infos["psm_0"]["reward_placed"].sum()
    assert placed > 0 and np.mean(far) < 0.002  # a contact that begins or ends within a rounding changes speeds


@pytest.mark.slow
def test_the_oracle_goes_there_and_back() -> None:
    """Two rounds and more in three minutes, in nine trials of ten."""
    many = BatchedEnv(TASK, SCENE, num_envs=32, difficulty="hard", engine="fused", device="cpu", goals="held_out")
    found = evaluate(many, load_policy("oracle", many), 32, 0)
    assert found["success_rate"] >= 0.9 and found["score"] >= 16 and found["score_time_s"] < 180.0
