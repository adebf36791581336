"""Learning from pictures: what networks are shown, and that a few updates learn from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning.train import Trainer, train
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.policy import load_policy, random_policy, zero_policy
from surgical_marl.runs.settings import Settings, load_config
from surgical_marl.scenes.load import load_scene
from tests.helpers.scenes import WATCHED

SMALL = [
    "num_envs=8",
    "max_steps=8",
    "steps_per_iteration=8",
    "iterations=1",
    "ppo.schedule=fixed",
    "network.hidden=[32]",
]


def settings(*overrides: str, scene: str = "ecm") -> Settings:
    return load_config("match_image", scene, [*SMALL, *overrides])


def made(scene: str, arrays: str = "torch") -> BatchedEnv:
    return BatchedEnv("match_image", scene, num_envs=8, max_steps=8, arrays=arrays)


@pytest.mark.parametrize("grouping, seer", [("type", "ecm"), ("agent", "ecm_0"), ("joint", "joint")])
def test_networks_are_shown_both_pictures_channels_first(grouping: Any, seer: str) -> None:
    env = made(WATCHED)
    observations, *_ = env.reset(0)
    layout = Layout(env, grouping)
    groups = layout.stack(observations)
    assert set(groups) == {*layout.counts, f"{seer}_pictures"}
    pictures = groups[f"{seer}_pictures"]
    assert pictures.shape == (8, 1, 6, 64, 64) and pictures.dtype == torch.uint8
    for place, name in enumerate(("image", "target")):
        shown = pictures[:, 0, 3 * place : 3 * place + 3]
        np.testing.assert_array_equal(shown.permute(0, 2, 3, 1), observations["ecm_0"][name])


@pytest.mark.parametrize(
    ("algo", "scene"),
    [
        ("ippo", "ecm"),
        pytest.param("mappo", "trimanual_psm_ecm", marks=pytest.mark.slow),
        pytest.param("joint", "ecm", marks=pytest.mark.slow),
    ],
)
def test_it_learns_from_pixels(algo: Any, scene: str) -> None:
    """The value loss falls to less than half; the encoder's weights move, and pictures alone change what is done."""
    training = Trainer(settings(f"algo={algo}", scene=scene), made(scene))
    (model,) = [model for model in training.algorithm.actor.models.values() if hasattr(model, "cnns")]
    before = [weight.detach().clone() for weight in model.cnns.parameters()]
    losses = [training.row(training.iterate())["value_loss"] for _ in range(6)]
    assert losses[-1] < 0.5 * losses[0]
    assert all((old != new).any() for old, new in zip(before, model.cnns.parameters(), strict=True))
    observations = training.env.get_observations()
    with torch.inference_mode():
        one = training.algorithm.actor(observations)
        for name in ("joint_pictures", "ecm_pictures"):
            if name in observations:
                observations[name] = observations[name].flip(0)
        other = training.algorithm.actor(observations)
    assert (one != other).any()


def test_a_run_is_saved_acts_and_goes_on(tmp_path: Path) -> None:
    run = train(settings(), out=tmp_path / "run")
    env = made("ecm", "numpy")
    result = evaluate(env, load_policy(run, env), episodes=8, seed=0)
    assert 0 < result["median_error_mm"] < 100
    train(settings("iterations=2"), out=run, resume=run)


def test_scripted_policies_act_on_dicts() -> None:
    """The oracle comes to the hidden pose's place; it can't be seen that the others do."""
    env = BatchedEnv("match_image", "ecm", num_envs=8)
    found = [evaluate(env, policy, 8, seed=1)["median_error_mm"] for policy in (
        load_policy("oracle", env), zero_policy(env), random_policy(env))]  # fmt: skip
    assert found[0] < 0.5 < 5 < found[1]
    observations, *_ = RslRlVecEnv(made("ecm")).env.reset(0)
    assert zero_policy(made("ecm"))(observations)["ecm_0"].shape == (8, 4)


@pytest.mark.parametrize("scene", ["ecm", "trimanual_psm_ecm"])
def test_poses_are_those_of_c_mujoco(scene: str) -> None:
    from surgical_marl.vision.kinematics import Kinematics, wp

    model, count = load_scene(scene).model, 4
    low, high = model.jnt_range.T
    qpos = np.random.default_rng(0).uniform(low, high, (count, model.nq))
    with wp.ScopedDevice("cpu"):
        found = Kinematics(model, count)
        found.qpos.assign(qpos.astype(np.float32))
        found.update()
    data = mujoco.MjData(model)
    for i in range(count):
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        for name in ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat"):
            wanted = getattr(data, name)
            np.testing.assert_allclose(getattr(found, name).numpy()[i].reshape(wanted.shape), wanted, atol=2e-6)


def test_pictures_need_hinges_and_slides() -> None:
    from surgical_marl.vision.kinematics import Kinematics

    free = '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match="joints are hinges and slides"):
        Kinematics(mujoco.MjModel.from_xml_string(free), 1)
