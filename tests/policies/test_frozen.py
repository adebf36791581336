"""Arms that keep still: a jaw stays where it is commanded to be, under all control modes."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.simulator import Simulator
from surgical_marl.policies.frozen import Frozen
from surgical_marl.policies.team import Team
from surgical_marl.policies.teammates import Teammates
from surgical_marl.scenes.load import load_scene
from surgical_marl.view.hand import Hand
from tests.helpers.commands import commander


@cache
def simulator(control: str) -> Simulator:
    return Simulator(load_scene("psm", control), 8)


def commanded(physics: Any, simulator: Simulator) -> SimpleNamespace:
    """An environment in which nothing moves but commands."""
    env = SimpleNamespace(scene=simulator.scene, num_envs=1, control_dt=simulator.control_dt, steps=np.ones(1, int),
                          physics=physics, action_space=lambda _: np.zeros(9),
                          action_terms=lambda _: {"jaw": slice(6, 7)})  # fmt: skip
    env.engine = SimpleNamespace(read=lambda *_: np.asarray(env.physics.ctrl)[None])
    return env


@pytest.mark.parametrize("opening", [0, 1, 4, 40])
@pytest.mark.parametrize("control", ["position", "velocity", "torque"])
def test_a_jaw_stays_where_it_is_commanded_to_be(control: str, opening: int) -> None:
    """To within one step's way, and exactly where it is open or closed. Two numbers of each action are a message."""
    made = simulator(control)
    scene, arm = made.scene, made.scene.mounts["psm_0"].arm
    env, command = commanded(made.home, made), commander(made)
    for _ in range(opening):
        env.physics = command(env.physics, {"psm_0": np.ones(7, np.float32) * arm.moves_jaw})
    before, still = np.asarray(env.physics.ctrl), Frozen(env, ["psm_0"])
    reach = made.control_dt * arm.speed[arm.moves_jaw][0] * (opening not in (0, 40))
    for _ in range(9):
        action = still({"psm_0": np.zeros((1, 3))})["psm_0"]
        assert action.shape == (1, 9) and action.dtype == np.float32 and not action[:, 7:].any()
        env.physics, env.steps = command(env.physics, {"psm_0": action[0, :7]}), env.steps + 1
        np.testing.assert_allclose(env.physics.ctrl, before, atol=reach + 1e-6)
        jaw = scene.model.actuator("psm_0/jaw_left").id
        others = np.delete(env.physics.ctrl - before, [jaw, jaw + 1])
        np.testing.assert_allclose(others, 0, atol=1e-6)


def test_partners_teammates_and_late_ones_keep_their_jaws() -> None:
    """In one environment the jaw is open and in the other closed. Then the episodes end, and both begin closed."""
    env = BatchedEnv("reach", "bimanual_psm", num_envs=2, max_steps=50, device="cpu")
    jaw = env.scene.qpos_index("psm_1")[-1]
    players: dict[str, Any] = {
        "teammate": Teammates(env, {"psm_1": "frozen"}).actions,
        "partner": Team(env, "zero", {"psm_1": "frozen"}),
        "late": Team(env, "zero", {"psm_1": "delayed"}),
    }
    for who, play in [*players.items(), *players.items()]:  # the second time none is told that episodes begin
        observations = env.reset(seed=1)[0]
        actions = {agent: np.zeros((2, 7), np.float32) for agent in env.agents}
        actions["psm_1"][0, -1] = 1
        for _ in range(20):
            observations = env.step(actions).observations
        before = env.qpos[:, jaw]
        env.steps = np.array([1, 1])
        for _ in range(20):
            observations = env.step({**actions, "psm_1": play(observations)["psm_1"]}).observations
        np.testing.assert_allclose(env.qpos[:, jaw], before, atol=1e-3, err_msg=who)
        np.testing.assert_allclose(before, [0.5, 0.02], atol=5e-3)
        env.steps = np.array([49, 49])
        for _ in range(4):
            found = play(observations)["psm_1"]
            observations = env.step({**actions, "psm_1": found}).observations
        assert not found.any(), who


def test_a_person_takes_over_an_open_jaw() -> None:
    env = BatchedEnv("reach", "bimanual_psm", num_envs=2, device="cpu")
    hand, observations = Hand(env, "psm_1"), env.reset(seed=1)[0]
    hand.hold(observations["psm_1"])
    assert not hand.jaw_open
    actions = {agent: np.zeros((2, 7), np.float32) for agent in env.agents}
    actions["psm_1"][:, -1] = 1
    for _ in range(20):
        observations = env.step(actions).observations
    hand.hold(observations["psm_1"])
    assert hand.jaw_open and (hand(observations["psm_1"])[:, -1] == 1).all()
