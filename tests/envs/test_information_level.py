"""Who knows what: the terms of each level, and that nobody observes what a level hides."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl import BatchedEnv
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import check_fits
from surgical_marl.tasks.base.options import Options, choices
from surgical_marl.tasks.base.task import TipTask
from surgical_marl.tasks.base.terms import Term
from surgical_marl.tasks.base.world import World
from tests.helpers import ROOT
from tests.helpers.scenes import PAIR

PAGE = ROOT / "docs" / "tasks.md"
ABOUT = {"arm": "the arm itself", "others": "other arms", "object": "objects and pictures", "goal": "its own goal",
         "team_goal": "the goal of all arms"}  # fmt: skip
"""What terms are about -> the row of the table in docs/tasks.md."""
CASES = [
    ("reach", "trimanual_psm_ecm"), ("track", PAIR), ("follow_path", PAIR),
    ("needle_handover", "bimanual_psm_needle"), ("peg_transfer", "trimanual_psm_ecm_pegs"),
    ("tissue_retract", "bimanual_psm_tissue"), ("needle_drive", "psm_suture"), ("suture", "bimanual_psm_suture"),
    pytest.param("match_image", "trimanual_psm_ecm", marks=pytest.mark.slow),
]  # fmt: skip


@cache
def made(task: str, scene: str, level: str = "task") -> Env:
    return Env(task, scene, knowledge=level)


def table() -> dict[str, dict[str, str]]:
    """Return the table of docs/tasks.md: row -> column -> cell."""
    part = PAGE.read_text().partition("## Who knows what")[2].partition("\n## ")[0]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines() if line.startswith("| ")]
    (_, *columns), *rows = lines
    return {first: dict(zip(columns, cells, strict=True)) for first, *cells in rows}


@pytest.mark.parametrize("level", choices("knowledge"))
@pytest.mark.parametrize(("task", "scene"), CASES)
def test_agents_observe_what_the_table_of_the_docs_says(task: str, scene: str, level: str) -> None:
    rows, usual, env = table(), made(task, scene), made(task, scene, level)
    kinds = {"object": env.scene.free_objects, "flap": env.scene.systems}
    for agent in env.agents:
        column = f"`{level}`"
        if level == "one":
            column += ", the one" if agent == env.task.informed else ", the others"
        expected = set()
        for name in (*usual.observed[agent].names, *usual.observed[agent].pictures):
            row = rows[ABOUT[str(env.task.terms(agent)[name].about)]]
            written = {name, *(re.sub(f"^({'|'.join(of)})_", f"<{kind}>_", name) for kind, of in kinds.items() if of)}
            assert any(f"`{one}`" in row["terms"] for one in written), name
            expected |= {name} if row[column] == "yes" else set()
        for mate in (other for other in env.agents if other != agent):
            for name in usual.observed[mate].names:
                theirs = rows.get(f"a teammate's: {ABOUT[str(env.task.terms(mate)[name].about)]}")
                expected |= {f"{mate}/{name}"} if theirs and theirs[column] == "yes" else set()
        assert {*env.observed[agent].names, *env.observed[agent].pictures} == expected
    assert env.state_space == usual.state_space


@pytest.mark.parametrize(("task", "scene"), CASES)
def test_nothing_that_an_arm_observes_depends_on_a_goal_that_it_does_not_know(task: str, scene: str) -> None:
    env = made(task, scene, "one")
    start = env.task.start(jax.random.PRNGKey(0))
    physics = env.plant.at_rest(None, start.qpos, start.poses)
    views, things = env.simulator.look(physics)[1], env.plant.things(physics, None)
    goal = env.task.remember(World(views, start.goal, {name: np.float32(0) for name in env.task.senses}, *things))
    found: dict[str, set[bytes]] = {agent: set() for agent in env.agents}
    for number in range(8):
        other = env.task.advance(env.task.start(jax.random.PRNGKey(number)).goal, 1.0)  # by then targets have moved
        if hasattr(goal, "best"):  # what was reached is no goal: arms have seen it
            other = goal._replace(row=other.row)
        for agent, observed in env.observed.items():
            found[agent].add(np.asarray(observed.read(env.task, World(views, other, {}, *things))).tobytes())
    knows = task != "match_image"  # whose goal is a picture, which is no part of the vector
    assert {agent: len(kinds) > 1 for agent, kinds in found.items()} == {
        agent: knows and agent == env.task.informed for agent in env.agents
    }


# `room` of tissue_retract is about the other tool too, as docs/tasks.md says
@pytest.mark.parametrize(("task", "scene"), [case for case in CASES if "tissue_retract" not in case])
def test_at_own_nothing_depends_on_other_arms(task: str, scene: str) -> None:
    env = made(task, scene, "own")
    start = env.task.start(jax.random.PRNGKey(0))
    physics = env.plant.at_rest(None, start.qpos, start.poses)
    things = env.plant.things(physics, None)
    moved = physics.with_arms(qpos=physics.qpos + np.float32(0.01))
    here, there = (env.simulator.look(now)[1] for now in (physics, moved))
    for agent, observed in env.observed.items():
        near = {part: getattr(there[agent], part) for part in ("nearest_tip", "min_distance")}
        mixed = {**there, agent: here[agent]._replace(**near)}
        one, other = (observed.read(env.task, World(views, start.goal, {}, *things)) for views in (here, mixed))
        np.testing.assert_array_equal(one, other)
        usual = made(task, scene).observed[agent]
        if len(env.agents) > 1 and scene != PAIR:  # whose arms are too far apart to sense each other
            both = (usual.read(env.task, World(views, start.goal, {}, *things)) for views in (here, mixed))
            assert not np.array_equal(*both)


def test_two_goals_look_alike_to_an_arm_that_knows_neither() -> None:
    """A whole episode, in which the arms do the same in both environments, bit for bit."""
    env = BatchedEnv("reach", PAIR, num_envs=2, knowledge="one", engine="fused", device="cpu", max_steps=40)
    env.reset(seed=0)
    carry = env.carry()
    env.set_carry({name: values if name == ".goal.targets" else values[[0, 0]] for name, values in carry.items()})
    assert not np.array_equal(*env.goal.targets)
    rng = np.random.default_rng(0)
    for number in range(40):
        step = env.step({a: np.repeat(rng.uniform(-1, 1, (1, 4)), 2, 0).astype(np.float32) for a in env.agents})
        np.testing.assert_array_equal(*step.final_observations["ecm_1"])
        assert not np.array_equal(*step.final_observations["ecm_0"])
        assert step.truncated.all() == (number == 39)
    knows = env.observation_terms("ecm_0")
    carry = env.carry()[".goal.targets"]
    for agent, name in (("ecm_0", "target"), ("ecm_1", "ecm_1/target")):
        np.testing.assert_allclose(step.observations["ecm_0"][:, knows[name]], carry[:, env.agents.index(agent)])


def test_what_arms_know_of_each_other_is_what_each_measures() -> None:
    env = BatchedEnv("reach", "trimanual_psm_ecm", num_envs=2, knowledge="all", engine="mjx", device="cpu")
    observations, *_ = env.reset(seed=0)
    for agent in env.agents:
        for name, here in (terms := env.observation_terms(agent)).items():
            mate, stroke, own = name.partition("/")
            if stroke:
                there = env.observation_terms(mate)[own]
                np.testing.assert_array_equal(observations[agent][:, here], observations[mate][:, there])
        assert sum("/" in name for name in terms) == 12
    assert env.types == {"psm": ["psm_0", "psm_1"], "ecm": ["ecm_0"]}  # arms of a type still share a network


def test_arms_that_know_unlike_things_are_of_unlike_kinds() -> None:
    env = BatchedEnv("reach", "trimanual_psm_ecm", num_envs=1, knowledge="one", engine="mjx", device="cpu")
    assert env.types == {"psm": ["psm_0"], "psm-seeing-2": ["psm_1"], "ecm": ["ecm_0"]}
    assert env.task.informed == "psm_0"


def test_critics_see_the_same_whoever_knows_what() -> None:
    states = [
        BatchedEnv("reach", "bimanual_psm", num_envs=2, knowledge=level, engine="mjx", device="cpu").reset(seed=0)[1]
        for level in choices("knowledge")
    ]
    for state in states[1:]:
        np.testing.assert_array_equal(state, states[0])


@pytest.mark.slow
@pytest.mark.parametrize("level", ["one", "all"])
def test_both_engines_show_the_same(level: str) -> None:
    env = Env("reach", "bimanual_psm", knowledge=level, messages=3, decimation=1, max_steps=3)
    engines = [make_engine(env, 4, kind, "cpu") for kind in ("mjx", "fused")]
    rng = np.random.default_rng(0)
    for engine in engines:
        engine.reset(0)
    for _ in range(5):
        actions = {a: rng.uniform(-1, 1, (4, env.num_actions(a))).astype(np.float32) for a in env.agents}
        for engine in engines:
            engine.step(actions)
        mjx, fused = (jax.tree.map(np.array, engine.outcome("numpy")) for engine in engines)
        for kind in ("observations", "final_observations", "state", "final_state"):
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), mjx[kind], fused[kind])
        np.testing.assert_array_equal(*(engine.read(".messages", "numpy") for engine in engines))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"knowledge": "none"}, "knowledge must be one of task, all, own, one, not 'none'"),
        ({"knowledge": "one", "observe": {"psm_1": ["qpos", "target"]}},
         "observe shows 'psm_1' 'target', which knowledge 'one' hides from it"),
        ({"knowledge": "own", "observe": {"psm_1": ["psm_0/qpos"]}}, "'psm_0/qpos', which knowledge 'own' hides"),
        ({"knowledge": "own", "observe": {"psm_1": ["psm_0/target"]}}, "'psm_0/target', which knowledge 'own' hides"),
        ({"observe": {"psm_1": ["psm_0/to_nearest_tip"]}}, "unknown observation term of 'psm_1'"),
    ],
)  # fmt: skip
def test_bad_knowledge_is_one_sentence(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        sm.parallel_env("reach", scene="bimanual_psm", **options)
    assert "\n" not in str(caught.value)


class Vague(TipTask):
    """A task with a term that does not say what it is about."""

    def terms(self, agent: str) -> dict[str, Any]:
        nothing = Term(lambda world: world.goal.targets[0], np.zeros(3), np.ones(3))
        return {**super().terms(agent), "wish": nothing}


def test_a_term_that_says_nothing_of_itself_is_hidden_from_nobody_by_mistake() -> None:
    from surgical_marl.envs.information_level import InformationLevel

    scene = made("reach", "trimanual_psm_ecm").scene
    vague = Vague(scene, Options("reach", "trimanual_psm_ecm"))
    assert "wish" in InformationLevel(vague, "psm_0", "task", 0).terms(vague)
    with pytest.raises(ValueError, match="knowledge 'one' needs terms that say what they are about, and 'wish'"):
        InformationLevel(vague, "psm_0", "one", 0)


def test_shipped_policies_play_what_the_task_shows() -> None:
    usual, other = (
        BatchedEnv("reach", "bimanual_psm", num_envs=2, knowledge=level, engine="mjx", device="cpu")
        for level in ("task", "own")
    )
    observations = {agent: seen.copy() for agent, seen in usual.reset(seed=0)[0].items()}
    action = load_policy("reach-bimanual_psm", usual)(observations)
    assert {agent: own.shape for agent, own in action.items()} == dict.fromkeys(usual.agents, (2, 7))
    with pytest.raises(ValueError, match="whose agents"):
        load_policy("reach-bimanual_psm", other)
    check_fits("reach-bimanual_psm", usual)
    with pytest.raises(ValueError, match="is of knowledge 'task', not 'own': a policy acts where it was trained"):
        check_fits("reach-bimanual_psm", other)
