"""The TorchRL face: TorchRL's own check, groups of agents of different kinds, and the numbers of the parallel face."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.scenes.placing import scenes_without_objects

pytest.importorskip("torchrl")
from torchrl.envs import MarlGroupMapType, check_env_specs

from surgical_marl.interfaces.torchrl import TorchRLEnv

COUNT, STEPS = 3, 4


def batched(scene: str = "bimanual_psm", task: str = "reach", **options: Any) -> BatchedEnv:
    return BatchedEnv(task, scene, num_envs=COUNT, max_steps=STEPS, arrays="torch", engine="fused", **options)


def playable() -> list[Any]:
    """`reach` on every scene, and tasks of vectors on their own. With objects to compile takes minutes: `-m slow`."""
    good = [("reach", scene) for scene in sm.list_scenes()]
    for task in sm.list_tasks():
        good += [(task, scene) for scene in TASKS.load(task).scenes or () if task != "match_image"]
    free = scenes_without_objects()
    return [pytest.param(*pair, marks=[] if pair[1] in free else pytest.mark.slow) for pair in good]


@pytest.mark.parametrize("grouping", [None, MarlGroupMapType.ONE_GROUP_PER_AGENT])
@pytest.mark.parametrize(("task", "scene"), playable())
def test_torchrl_accepts_every_scene(task: str, scene: str, grouping: Any) -> None:
    check_env_specs(TorchRLEnv(batched(scene, task), grouping), return_contiguous=True, seed=0)


@pytest.mark.parametrize(("task", "scene"), playable())
def test_all_agents_are_one_group_if_they_are_alike(task: str, scene: str) -> None:
    env, one = batched(scene, task), MarlGroupMapType.ALL_IN_ONE_GROUP
    if len(env.types) == 1:
        check_env_specs(TorchRLEnv(env, one), return_contiguous=True, seed=0)
    else:
        with pytest.raises(ValueError, match="they observe unlike things"):
            TorchRLEnv(env, one)


@pytest.mark.parametrize("scene", ["ecm", "trimanual_psm_ecm"])
def test_torchrl_accepts_pictures(scene: str) -> None:
    env = TorchRLEnv(batched(scene, "match_image"))
    check_env_specs(env, seed=0)
    pictures = env.rollout(1)["ecm", "observation", "image"]
    assert pictures.dtype == torch.uint8 and pictures.shape == (COUNT, 1, 1, 64, 64, 3)


@pytest.mark.parametrize(
    ("task", "scene"),
    [
        ("reach", "trimanual_psm_ecm"),
        pytest.param("peg_transfer", "trimanual_psm_ecm_pegs", marks=pytest.mark.slow),
    ],
)
def test_agents_of_a_kind_are_a_group_with_the_numbers_of_the_batch(task: str, scene: str) -> None:
    """Over the ends of episodes: "next" is the last of an episode, and the reset that follows is the next one."""
    env, plain = TorchRLEnv(batched(scene, task)), batched(scene, task)
    assert env.group_map == {"ecm": ["ecm_0"], "psm": ["psm_0", "psm_1"]}
    env.set_seed(7)
    data, (observations, state, _) = env.reset(), plain.reset(7)
    for step in range(2 * STEPS):
        for group, agents in env.group_map.items():
            for place, agent in enumerate(agents):
                assert torch.equal(data[group, "observation"][:, place], observations[agent])
        assert torch.equal(data["state"], state)
        data = env.rand_action(data)
        given = {a: data[g, "action"][:, k] for g, own in env.group_map.items() for k, a in enumerate(own)}
        stepped, data = env.step_and_maybe_reset(data)
        expected = plain.step(given)
        observations, state = expected.observations, expected.state
        after = stepped["next"]
        assert torch.equal(after["state"], expected.final_state)
        assert torch.equal(after["psm", "reward"][:, 1, 0], expected.rewards["psm_1"])
        assert torch.equal(after["psm", "info", "success"][:, 0], expected.infos["psm_0"]["success"])
        assert after["truncated"].all() == after["done"].all() == ((step + 1) % STEPS == 0)
        assert not after["terminated"].any()


def test_episodes_of_different_lengths_are_reset_one_by_one() -> None:
    env = TorchRLEnv(batched("psm"))
    data = env.reset()
    env.env.steps = [0, 1, 2]
    ended = []
    for _ in range(STEPS):
        stepped, data = env.step_and_maybe_reset(env.rand_action(data))
        ended.append(stepped["next", "done"][:, 0].tolist())
    assert ended == [[False, False, False], [False, False, True], [False, True, False], [True, False, False]]
    with pytest.raises(ValueError, match="2 environments are within an episode: reset all, or those that ended"):
        data["_reset"] = torch.ones(COUNT, 1, dtype=torch.bool)
        data["_reset"][0] = False
        env.reset(data)


def test_one_agents_tensors_are_the_batchs_own() -> None:
    env = TorchRLEnv(batched("psm"))
    seen: list[Any] = []
    inner = env.env.step
    env.env.step = lambda actions: seen.append(inner(actions)) or seen[-1]  # type: ignore[method-assign]
    after = env._step(env.rand_action(env.reset()))
    assert after["psm", "observation"].data_ptr() == seen[0].final_observations["psm_0"].data_ptr()


def test_it_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="arrays='torch', not arrays='numpy'"):
        TorchRLEnv(BatchedEnv("reach", "psm"))
    with pytest.raises(ValueError, match="group 'agents' can't hold 'psm_0' and 'ecm_0': they observe unlike things"):
        TorchRLEnv(batched("trimanual_psm_ecm"), {"agents": ["psm_0", "psm_1", "ecm_0"]})
    env = TorchRLEnv(batched("psm"))
    env.close()
    with pytest.raises(ValueError, match="the environment is closed"):
        env.env.reset()
