"""Episodes of a policy and of takes: what was seen and done, at which rate, from where on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surgical_marl.data.recording import Recording, played, replayed
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.goal_set import episode_seed
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.signals import FORMS, Signals, check_form
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.view.session import Session
from surgical_marl.view.take import OpenTake, open_take, start_of

SETTINGS = Settings(task="reach", scene="psm", seed=3, max_steps=12, device="cpu")
ARM = "psm_0"


@pytest.fixture(scope="module")
def env() -> Iterator[BatchedEnv]:
    made = make_env(SETTINGS, 2, "numpy")
    yield made
    made.close()


def episodes(env: BatchedEnv, count: int, after: tuple[int, int] | None = None, who: str = "random") -> list[Recording]:
    return list(islice(played(env, load_policy(who, env), 5, after), count))


def test_an_episode_holds_what_an_environment_says(env: BatchedEnv) -> None:
    _, second = episodes(env, 2)
    env.autoreset = False
    observations, state, _ = env.reset(episode_seed(5, 0))
    for row in range(len(second)):
        assert np.array_equal(second.seen[f"observations/{ARM}"][row], observations[ARM][1])
        assert np.array_equal(second.seen["state"][row], state[1])
        assert np.array_equal(second.seen["qpos"][row], env.qpos[1])
        actions = np.zeros((2, second.done[f"actions/{ARM}"].shape[1]), np.float32)
        actions[1] = second.done[f"actions/{ARM}"][row]
        step = env.step({ARM: actions})
        observations, state = step.observations, step.state
        assert second.done[f"rewards/{ARM}"][row] == step.rewards[ARM][1]
        assert second.done["success"][row] == step.infos[ARM]["success"][1]
    assert len(second) == 12 and second.done["truncated"].tolist() == [False] * 11 + [True]
    assert np.array_equal(second.seen["qpos"][-1], env.qpos[1])


def test_episodes_go_on_after_a_place(env: BatchedEnv) -> None:
    every = episodes(env, 4)
    assert [recording.place for recording in every] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    for number in range(3):
        (later,) = episodes(env, 1, every[number].place)
        assert later.place == every[number + 1].place
        assert all(np.array_equal(later.seen[name], every[number + 1].seen[name]) for name in later.seen)


@pytest.mark.parametrize("stride, rows", [(1, 12), (5, 3), (12, 1), (20, 1)])
def test_rows_stand_for_several_steps(env: BatchedEnv, stride: int, rows: int) -> None:
    (whole,) = episodes(env, 1)
    part = whole.every(stride)
    assert len(part) == rows and len(part.seen["qpos"]) == rows + 1
    rewards = [recording.done[f"rewards/{ARM}"].sum() for recording in (whole, part)]
    assert rewards[0] == pytest.approx(rewards[1], rel=1e-5)
    for row in range(rows):
        assert np.array_equal(part.seen["qpos"][row], whole.seen["qpos"][row * stride])
    assert np.array_equal(part.seen["qpos"][-1], whole.seen["qpos"][-1])
    assert np.array_equal(part.done["truncated"][-1:], [True])


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenTake]:
    """A take of two environments, of 30 steps: two whole episodes, and half of one."""
    folder = tmp_path_factory.mktemp("takes")
    session = Session(SETTINGS, "random", num_envs=2, record=folder)
    for _ in range(30):
        session.step()
    session.close()
    opened = open_take(folder / "take-0001.npz", observations="si")
    yield opened
    opened.env.close()


def again(take: OpenTake, arrays: Mapping[str, np.ndarray] | None = None, **about: Any) -> list[Recording]:
    return list(replayed(take.env, arrays or take.arrays, {**take.about, **about}, Path("take.npz")))


def test_a_take_is_cut_into_episodes(take: OpenTake) -> None:
    found = again(take)
    assert [len(recording) for recording in found] == [12, 12, 12, 12, 6, 6]
    assert [recording.place for recording in found] == [(0, number) for number in range(6)]
    assert all(recording.done["truncated"][-1] for recording in found)
    for number, recording in enumerate(found):
        index, first = number % 2, number // 2 * 12
        kept = slice(first, first + len(recording))
        for name in (f"actions/{ARM}", f"rewards/{ARM}"):
            assert np.array_equal(recording.done[name], take.arrays[name][kept, index]), (number, name)
        # the take has the first posture of the next episode where one ended
        last = len(recording) - 1
        assert np.array_equal(recording.seen["qpos"][1 : last + 1], take.arrays["qpos"][kept, index][:last])


def test_what_a_take_does_not_know_is_left_out(take: OpenTake) -> None:
    """A take may begin in the middle of an episode: what was observed before its first step is not in it."""
    take.env.set_carry(start_of(take.arrays))
    for step in range(5):
        take.env.step({ARM: take.arrays[f"actions/{ARM}"][step]})
    later = {f"start{name}": value for name, value in take.env.carry().items()}
    later |= {name: value[5:] for name, value in take.arrays.items() if not name.startswith("start")}
    assert [len(recording) for recording in again(take, later)] == [12, 12, 6, 6]


def test_a_take_that_leads_to_other_numbers_is_refused(take: OpenTake) -> None:
    other = {**take.arrays, "qpos": take.arrays["qpos"].copy()}
    other["qpos"][3] += 1e-6
    with pytest.raises(ValueError, match=r"other numbers here from step 3 on$"):
        again(take, other)
    with pytest.raises(ValueError, match=r"with other versions than it was recorded with: numpy 0.1 -> "):
        again(take, other, versions={"numpy": "0.1"})


@pytest.mark.parametrize("form", FORMS)
def test_states_and_actions_have_a_name_for_each_number(env: BatchedEnv, form: str) -> None:
    (recording,) = episodes(env, 1)
    signals = Signals(env, form)
    state, action = signals.state(recording), signals.action(recording)
    assert state.shape == (13, len(signals.state_names)) and action.shape == (12, len(signals.action_names))
    assert state.dtype == action.dtype == np.float32
    assert len(set(signals.action_names)) == len(signals.action_names)
    assert signals.parts(signals.action_names) == {ARM: slice(0, action.shape[1])}


def test_poses_are_those_of_the_tip(env: BatchedEnv) -> None:
    (recording,) = episodes(env, 1)
    arm, terms = env.scene.mounts[ARM].arm, env.observation_terms(ARM)
    state = Signals(env, "cartesian").state(recording)
    tips = recording.seen[f"observations/{ARM}"][:, terms["tool_tip"]]
    np.testing.assert_allclose(state[:, :3], tips, atol=1e-6)
    assert ((state[1:, 3:7] * state[:-1, 3:7]).sum(1) > 0).all(), "a quaternion changed its sign"
    np.testing.assert_allclose(np.linalg.norm(state[:, 3:7], axis=1), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(
        state[:, 7:], recording.seen[f"observations/{ARM}"][:, terms["qpos"]][:, arm.moves_jaw]
    )


def test_relative_actions_lead_from_the_tip_to_the_target(env: BatchedEnv) -> None:
    (recording,) = episodes(env, 1)
    state, wanted = (of(recording) for of in (Signals(env, "cartesian").state, Signals(env, "cartesian").action))
    relative = Signals(env, "relative").action(recording)
    here = Rotation.from_quat(state[:-1, 3:7])
    np.testing.assert_allclose(here.apply(relative[:, :3]) + state[:-1, :3], wanted[:, :3], atol=1e-6)
    columns = relative[:, 3:9].reshape(-1, 2, 3)
    turn = np.stack([*np.moveaxis(columns, 1, 0), np.cross(columns[:, 0], columns[:, 1])], -1)
    there = here * Rotation.from_matrix(turn)
    assert (there * Rotation.from_quat(wanted[:, 3:7]).inv()).magnitude().max() < 1e-5
    np.testing.assert_array_equal(relative[:, 9:], wanted[:, 7:])


def test_joint_actions_are_the_next_commands(env: BatchedEnv) -> None:
    (recording,) = episodes(env, 1)
    commands = recording.seen[f"observations/{ARM}"][:, env.observation_terms(ARM)["command"]]
    np.testing.assert_array_equal(Signals(env, "joint").action(recording), commands[1:])
    np.testing.assert_array_equal(Signals(env, "joint").action(recording.every(5)), commands[[5, 10, 12]])
    np.testing.assert_array_equal(Signals(env, "env").action(recording), recording.done[f"actions/{ARM}"])


@pytest.mark.parametrize(
    "form, control, stride, words",
    [
        ("env", "position", 2, "--actions env"),
        ("joint", "torque", 1, "'torque'"),
        ("relative", "velocity", 1, "cartesian, position"),
    ],
)
def test_forms_that_do_not_fit_are_refused(form: str, control: str, stride: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_form(form, control, stride)
