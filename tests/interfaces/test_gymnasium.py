"""One environment behind Gymnasium: its own check on everything that can be made, time limits, every wrapper."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import vector

import surgical_marl as sm
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.placing import scenes_without_objects
from tests.helpers import ROOT

REACH, MATCH = "surgical_marl/Reach-v0", "surgical_marl/MatchImage-v0"
STEPS = 5
PYPROJECT = ROOT / "pyproject.toml"


def gymnasium_id(task: str) -> str:
    return f"surgical_marl/{''.join(part.title() for part in task.split('_'))}-v0"


QUICK = {("reach", "psm"), ("reach", "bimanual_psm"), ("track", "ecm"), ("match_image", "ecm")}


def playable() -> list[Any]:
    """Every task on every scene that it can be played on: a few at once, all of them with `-m slow`."""
    good = [(task, scene) for task in sm.list_tasks() for scene in TASKS.load(task).scenes or sm.list_scenes()]
    return [pytest.param(*pair, marks=[] if pair in QUICK else pytest.mark.slow) for pair in good]


def quick_or_slow(task: str) -> Any:
    """The task; one whose own scene has objects or many arms compiles for half a minute, so only with `-m slow`."""
    own = TASKS.load(task).default_scene
    quick = own is None or (own in scenes_without_objects() and len(load_scene(own).agents) == 1)
    return pytest.param(task, marks=[] if quick else pytest.mark.slow)


@pytest.mark.parametrize(("task", "scene"), playable())
def test_gymnasium_accepts_every_task_on_every_scene_without_a_warning(task: str, scene: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(gymnasium_id(task), scene=scene, device="cpu", render_mode="rgb_array")
        check_env(env.unwrapped, skip_render_check=scene not in ("psm", "bimanual_psm"))  # pictures take seconds
    assert env.spec.max_episode_steps == env.unwrapped.batch.max_steps


@pytest.mark.parametrize("task", [quick_or_slow(task) for task in sm.list_tasks()])
def test_every_id_can_be_made_with_its_defaults(task: str) -> None:
    env = gymnasium.make(gymnasium_id(task))
    own = TASKS.load(task).default_scene
    assert len(env.unwrapped.batch.agents) == (1 if own is None else len(load_scene(own).agents))
    assert env.observation_space.contains(env.reset(seed=0)[0])


@pytest.mark.parametrize(
    ("given", "limit"),
    [
        ({}, 100),
        ({"max_steps": 6}, 6),
        ({"max_episode_steps": 6}, 6),
        ({"max_episode_steps": 120}, 120),
        ({"max_episode_steps": -1}, 100),
        ({"max_steps": 12, "max_episode_steps": 6}, 6),
        ({"max_steps": 6, "max_episode_steps": 12}, 12),
    ],
)
def test_the_spec_says_when_episodes_end(given: dict[str, int], limit: int) -> None:
    first = gymnasium.make(REACH, device="cpu", **given)
    for env in (first, gymnasium.make(first.spec)):
        assert env.spec.max_episode_steps == limit
        for _ in range(2):
            env.reset(seed=0)
            ends = [env.step(np.zeros(7, np.float32))[3] for _ in range(limit)]
            assert ends == [False] * (limit - 1) + [True]
    if given.get("max_episode_steps") != -1:
        assert gymnasium.make_vec(REACH, device="cpu", **given).spec.max_episode_steps == limit


def test_np_random_is_seeded_by_a_reset() -> None:
    env = gymnasium.make(REACH, device="cpu")
    env.reset(seed=np.int64(4))
    assert env.np_random_seed == 4
    assert env.np_random.random() == np.random.Generator(np.random.PCG64(4)).random()
    drawn = env.np_random.random()
    env.reset()
    assert env.np_random.random() != drawn and env.np_random_seed == 4


def test_an_arm_alone_is_told_all_that_the_parallel_face_tells() -> None:
    env, team = gymnasium.make(REACH, device="cpu"), sm.parallel_env("reach", scene="psm", device="cpu")
    assert env.reset(seed=0)[1] == team.reset(seed=0)[1]["psm_0"]
    assert env.step(np.ones(7))[-1] == team.step({"psm_0": np.ones(7)})[-1]["psm_0"]


def test_a_closed_environment_says_so() -> None:
    env = gymnasium.make(REACH, device="cpu", render_mode="rgb_array")
    env.reset(seed=0)
    env.close()
    env.close()
    for call in (env.unwrapped.reset, env.unwrapped.render, lambda: env.step(np.zeros(7))):
        with pytest.raises(ValueError, match="closed"):
            call()


LEFT_OUT = {"AtariPreprocessing": "is for Atari games", "vector": "is a module"}
DICTS = ("FilterObservation", "FlattenObservation", "GrayscaleObservation", "ResizeObservation")
"""Wrappers of observations that are a dict of pictures and more, or one picture of it."""
ARRAYS = ("ArrayConversion", "JaxToNumpy", "JaxToTorch", "NumpyToTorch")
NEEDS = {
    "ResizeObservation": "cv2",
    "HumanRendering": "pygame",
    "RecordVideo": "moviepy",
    **dict.fromkeys(ARRAYS, "array_api_compat"),
}


def arguments(name: str, env: Any, folder: Path) -> dict[str, Any]:
    """What a wrapper needs beside its environment."""
    import jax.numpy as jnp

    single = "single_" if isinstance(env, gymnasium.vector.VectorEnv) else ""
    rewards = {"min_reward": -1.0, "max_reward": 1.0}
    known: dict[str, dict[str, Any]] = {
        "AddWhiteNoise": {"probability_of_noise_per_pixel": 0.5},
        "ArrayConversion": {"env_xp": np, "target_xp": jnp},
        "ClipReward": rewards,
        "DelayObservation": {"delay": 2},
        "DiscretizeAction": {"bins": 3},
        "DiscretizeObservation": {"bins": 5, "multidiscrete": True},
        "DtypeObservation": {"dtype": np.float64},
        "FilterObservation": {"filter_keys": ["image"]},
        "FrameStackObservation": {"stack_size": 3},
        "ObstructView": {"obstructed_pixels_ratio": 0.2, "obstruction_width": 8},
        "RecordVideo": {"video_folder": str(folder), "disable_logger": True},
        "RepeatAction": {"num_repeats": 2},
        "RescaleAction": {"min_action": np.float32(-2), "max_action": np.float32(2)},
        "RescaleObservation": {"min_obs": np.float32(-1), "max_obs": np.float32(1)},
        "ReshapeObservation": {"shape": (5, 6)},
        "ResizeObservation": {"shape": (32, 32)},
        "StickyAction": {"repeat_action_probability": 0.5},
        "TimeLimit": {"max_episode_steps": 3},
        "TransformAction": {"func": np.negative, f"{single}action_space": getattr(env, f"{single}action_space")},
        "TransformObservation": {
            "func": np.copy,
            f"{single}observation_space": getattr(env, f"{single}observation_space"),
        },
        "TransformReward": {"func": np.negative},
        "VectorizeTransformAction": {"wrapper": wrappers.ClipAction},
        "VectorizeTransformObservation": {"wrapper": wrappers.DtypeObservation, "dtype": np.float64},
        "VectorizeTransformReward": {"wrapper": wrappers.ClipReward, **rewards},
    }
    return known.get(name, {})


def wrapped(module: Any, name: str, env: Any, folder: Path) -> Any:
    import jax.numpy as jnp

    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    if name in ("GrayscaleObservation", "ResizeObservation"):
        if module is vector:
            space = env.single_observation_space["image"]
            env = vector.TransformObservation(env, lambda seen: seen["image"], single_observation_space=space)
        else:
            env = wrappers.TransformObservation(env, lambda seen: seen["image"], env.observation_space["image"])
    if name.startswith("Jax"):
        env = module.ArrayConversion(env, env_xp=np, target_xp=jnp)
    return getattr(module, name)(env, **arguments(name, env, folder))


@pytest.mark.parametrize("name", [name for name in wrappers.__all__ if name not in LEFT_OUT])
def test_every_wrapper_of_gymnasium_works(name: str, tmp_path: Path) -> None:
    render = name in ("AddRenderObservation", "AddWhiteNoise", "ObstructView", "RenderCollection", "RecordVideo",
                      "HumanRendering")  # fmt: skip
    env = gymnasium.make(
        MATCH if name in DICTS else REACH, max_steps=STEPS, device="cpu", render_mode="rgb_array" if render else None
    )
    env = wrapped(wrappers, name, env, tmp_path)
    for seed in (0, None):
        observation, _ = env.reset(seed=seed)
        for _ in range(STEPS):
            if name not in ARRAYS:
                assert env.observation_space.contains(observation)
            observation, reward, terminated, truncated, _ = env.step(_taken(name, env.action_space.sample()))
            assert np.isfinite(float(reward)) and not terminated
            if truncated:
                break
        assert truncated
    if render and name not in ("RecordVideo", "HumanRendering"):
        assert env.render() is not None
    env.close()


@pytest.mark.parametrize("mode", gymnasium.vector.AutoresetMode)
@pytest.mark.parametrize("name", vector.__all__)
def test_every_wrapper_of_vector_environments_works(name: str, mode: Any, tmp_path: Path) -> None:
    """All do with `NEXT_STEP`; with the other modes all do that Gymnasium lets."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    same_step = mode is gymnasium.vector.AutoresetMode.SAME_STEP
    if same_step and issubclass(getattr(vector, name), gymnasium.vector.VectorObservationWrapper):
        pytest.skip("Gymnasium's own wrappers of observations refuse SAME_STEP")
    if same_step and name in ARRAYS:
        pytest.skip("final_obs is an array of objects, as in SyncVectorEnv, and other libraries have none")
    if name == "NormalizeObservation" and mode is not gymnasium.vector.AutoresetMode.NEXT_STEP:
        pytest.skip("Gymnasium's own NormalizeObservation takes NEXT_STEP alone")
    given = {"render_mode": "rgb_array"} if name in ("RecordVideo", "HumanRendering") else {}
    envs = gymnasium.make_vec(
        MATCH if name in DICTS else REACH, num_envs=2, max_steps=2, device="cpu", autoreset_mode=mode, **given
    )
    envs = wrapped(vector, name, envs, tmp_path)
    observations, _ = envs.reset(seed=[0, 1])
    ends = 0
    for _ in range(5):
        if name not in ARRAYS:
            assert envs.observation_space.contains(observations)
        observations, _, terminated, truncated, _ = envs.step(_taken(name, envs.action_space.sample()))
        done = np.logical_or(np.asarray(terminated), np.asarray(truncated))
        ends += int(done.sum())
        if mode is gymnasium.vector.AutoresetMode.DISABLED and done.any():
            observations, _ = envs.reset(options={"reset_mask": done})
    assert ends == 4
    envs.close()


def _taken(name: str, action: np.ndarray) -> Any:
    """Return an action in the library that the wrapper's environment is used with."""
    if name == "ArrayConversion":
        import jax.numpy as jnp

        return jnp.asarray(action)
    if name.endswith("ToTorch"):
        import torch

        return torch.from_numpy(action)
    return action


def test_infos_can_be_lists_too() -> None:
    envs = gymnasium.make_vec(REACH, num_envs=2, scene="bimanual_psm", max_steps=2, device="cpu")
    envs = vector.DictInfoToList(vector.RecordEpisodeStatistics(envs))
    one = gymnasium.make(REACH, scene="bimanual_psm", max_steps=2, device="cpu")
    _, infos = envs.reset(seed=[3, 4])
    assert infos[0].keys() == one.reset(seed=3)[1].keys()
    for _ in range(2):
        infos = envs.step(np.ones((2, 14), np.float32))[-1]
        last = one.step(np.ones(14, np.float32))[-1]
    assert infos[1]["episode"]["l"] == 2 and infos[0]["final_info"].keys() == last.keys()
    assert infos[0]["final_info"]["agents"]["psm_1"]["tip_error"] == pytest.approx(last["agents"]["psm_1"]["tip_error"])


def run(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PYPROJECT.parent)
    assert not done.returncode, done.stderr


def test_the_entry_point_registers_all_ids_once_and_without_a_warning() -> None:
    """As Gymnasium loaded plugins before 1.0, and as a tool may: within the namespace that the entry point names."""
    ((name, value),) = tomllib.loads(PYPROJECT.read_text())["project"]["entry-points"]["gymnasium.envs"].items()
    wanted = [gymnasium_id(task) for task in sm.list_tasks()]
    run(
        f"""
import warnings
from importlib.metadata import EntryPoint
from gymnasium.envs.registration import namespace, registry
warnings.simplefilter("error")
with namespace({name!r}):
    EntryPoint({name!r}, {value!r}, "gymnasium.envs").load()()
import surgical_marl
assert [name for name in registry if "surgical" in name] == {wanted!r}
"""
    )


def test_an_id_with_the_package_is_found_without_an_import() -> None:
    """Also in processes that others start, which have imported nothing."""
    run(
        """
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import gymnasium

with ProcessPoolExecutor(1, get_context("spawn")) as started:
    env = started.submit(gymnasium.make, "surgical_marl:surgical_marl/Reach-v0", device="cpu").result()
assert env.spec.max_episode_steps == 100 and env.reset(seed=0)[0].shape == (30,)
"""
    )
