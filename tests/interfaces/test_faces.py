"""The parallel faces: PettingZoo's own tests, equal numbers behind every face, and what is freed at the end."""

from __future__ import annotations

import gc
import itertools
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import gymnasium
import matplotlib
import numpy as np
import pettingzoo.test
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner

import surgical_marl as sm
from surgical_marl.engines.fused import kernel
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.view.record import ScenePicture
from tests.helpers.scenes import APART

STEPS = 6
CONTROLS = ("position", "velocity", "torque")
QUICK = {("reach", "psm", "position"), ("track", "star", "position"), ("match_image", "ecm", "position")}


def combinations() -> list[Any]:
    """Every task on every scene that it has, in every control mode: a few at once, all of them with `-m slow`."""
    every = itertools.product(sm.list_tasks(), sm.list_scenes(), CONTROLS)
    return [pytest.param(*c, marks=[] if c in QUICK else pytest.mark.slow, id="-".join(c)) for c in every]


def makers(task: str, scene: str, control: str) -> list[Callable[..., Any]]:
    """`parallel_env`, `env` and `raw_env` of the task's module; a skip if the task does not go with the scene."""
    try:
        sm.parallel_env(task, scene=scene, control=control).close()
    except ValueError as error:
        pytest.skip(str(error))
    module = getattr(sm, f"{task}_v0")
    functions = (module.parallel_env, module.env, module.raw_env)
    return [lambda f=f, **o: f(**{"scene": scene, "control": control, "max_cycles": STEPS, **o}) for f in functions]


@pytest.mark.parametrize(("task", "scene", "control"), combinations())
def test_pettingzoo_accepts_every_task_scene_and_control(task: str, scene: str, control: str) -> None:
    parallel_env, env, raw_env = makers(task, scene, control)
    pettingzoo.test.parallel_api_test(parallel_env(), num_cycles=3 * STEPS)
    pettingzoo.test.parallel_seed_test(parallel_env, num_cycles=STEPS)
    for make in (env, raw_env):
        pettingzoo.test.api_test(make(), num_cycles=3 * STEPS)
    pettingzoo.test.seed_test(env, num_cycles=STEPS)
    module = type("Module", (), {"parallel_env": staticmethod(parallel_env), "env": staticmethod(env)})
    pettingzoo.test.max_cycles_test(module)


def test_pettingzoo_accepts_both_ways_to_render(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    pettingzoo.test.render_test(lambda render_mode: sm.reach_v0.env(scene="psm", render_mode=render_mode))


def test_a_window_follows_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot

    monkeypatch.setenv("MPLBACKEND", "agg")
    before = set(pyplot.get_fignums())
    env = sm.parallel_env("reach", scene="psm", render_mode="human")
    pictures = sm.parallel_env("reach", scene="psm", render_mode="rgb_array")
    for each in (env, pictures):
        each.reset(seed=0)
    (number,) = set(pyplot.get_fignums()) - before
    (shown,) = pyplot.figure(number).axes[0].images
    for _ in range(2):
        np.testing.assert_array_equal(shown.get_array(), pictures.render())
        for each in (env, pictures):
            each.step({"psm_0": np.ones(7)})
    assert env.render() is None and env.metadata["render_modes"] == ["human", "rgb_array"]
    env.close()
    assert set(pyplot.get_fignums()) == before


def test_a_window_that_was_closed_stays_closed_and_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot

    monkeypatch.setenv("MPLBACKEND", "agg")
    before = set(pyplot.get_fignums())
    env = sm.parallel_env("reach", scene="psm", render_mode="human")
    env.reset(seed=0)
    (number,) = set(pyplot.get_fignums()) - before
    pyplot.close(number)
    monkeypatch.setattr(ScenePicture, "draw", lambda self: pytest.fail("drawn for nobody"))
    env.step({"psm_0": np.ones(7)})
    env.reset()
    assert set(pyplot.get_fignums()) == before


def test_without_a_display_a_window_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MPLBACKEND", raising=False)
    monkeypatch.setattr(matplotlib, "get_backend", lambda: "agg")
    with pytest.raises(ValueError, match="render_mode 'human' needs a display, and there is none: use"):
        sm.parallel_env("reach", scene="psm", render_mode="human")
    with pytest.raises(ValueError, match=r"render_size \(0, 9\) must be width and height"):
        sm.parallel_env("reach", scene="psm", render_mode="rgb_array", render_size=(0, 9))
    with pytest.raises(ValueError, match="unknown render_mode 'ansi'; the modes are None, 'human' and 'rgb_array'"):
        sm.parallel_env("reach", scene="psm", render_mode="ansi")


def test_wrappers_find_random_numbers_that_a_seed_begins_anew() -> None:
    env, other = (sm.parallel_env("reach", scene="psm", **form) for form in ({}, {"num_envs": 2}))
    drawn = []
    for each in (env, env, other):
        each.reset(seed=4)
        drawn.append(each.np_random.integers(0, 1000, 5).tolist())
        each.reset()
    assert drawn[0] == drawn[1] == drawn[2]
    assert env.np_random.integers(0, 1000, 5).tolist() != drawn[0]


@pytest.mark.parametrize("form", [{}, {"num_envs": 2}, {"num_envs": 2, "arrays": "torch"}])
def test_spaces_are_there_as_dicts_too(form: dict[str, Any]) -> None:
    env = sm.parallel_env("reach", scene=APART, **form)
    for spaces, space in ((env.observation_spaces, env.observation_space), (env.action_spaces, env.action_space)):
        assert list(spaces) == env.possible_agents
        assert all(spaces[agent] is space(agent) for agent in spaces)


@pytest.mark.parametrize("form", [{}, {"num_envs": 2}])
def test_an_environment_is_a_direct_child_of_pettingzoos_class(form: dict[str, Any]) -> None:
    """skrl tells environments apart by their direct bases."""
    env = sm.parallel_env("reach", scene="psm", **form)
    assert pettingzoo.ParallelEnv in type(env).__bases__ and pettingzoo.ParallelEnv in type(env.unwrapped).__bases__
    assert gymnasium.Env in type(gymnasium.make("surgical_marl/Reach-v0", scene="psm").unwrapped).__bases__
    many = gymnasium.make_vec("surgical_marl/Reach-v0", scene="psm", num_envs=2)
    assert gymnasium.vector.VectorEnv in type(many.unwrapped).__bases__


def test_after_an_episode_no_agents_do_nothing() -> None:
    """PettingZoo's convention, which SuperSuit's `black_death` counts on."""
    env = sm.parallel_env("reach", scene="psm", max_steps=1)
    with pytest.raises(ValueError, match="no episode is under way"):
        env.step({})
    env.reset(seed=0)
    env.step({"psm_0": np.zeros(7)})
    assert env.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(ValueError, match="no episode is under way"):
        env.step({"psm_0": np.zeros(7)})
    assert env.reset()[0]["psm_0"].shape == env.observation_space("psm_0").shape


def test_black_death_and_padding_make_arms_of_different_kinds_alike() -> None:
    supersuit = pytest.importorskip("supersuit")
    env = sm.parallel_env("reach", scene=APART, max_steps=STEPS)
    env = supersuit.black_death_v3(supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env)))
    many = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 2, num_cpus=0)
    many.reset(seed=0)
    dones = [many.step(np.zeros((6, 7), np.float32))[3].all() for _ in range(3 * STEPS)]
    assert sum(map(bool, dones)) == 2  # black death adds a step to each episode


SCENE, AGENTS, WIDTH = "bimanual_psm", ("psm_0", "psm_1"), 7


def batch(arrays: str) -> BatchedEnv:
    return BatchedEnv("reach", SCENE, num_envs=1, arrays=arrays, max_steps=STEPS, engine="fused", observations="scaled")


def numbers_of_batch(arrays: str, actions: np.ndarray) -> list[np.ndarray]:
    env = batch(arrays)
    seen = [env.reset(11)[1]]
    for action in actions:
        seen.append(env.step({a: action[None, i] for i, a in enumerate(AGENTS)}).final_state)
    return [np.asarray(state)[0] for state in seen]


def numbers_of_parallel(actions: np.ndarray, make: Any = None) -> list[np.ndarray]:
    env = (make or sm.reach_v0.parallel_env)(scene=SCENE, max_steps=STEPS, engine="fused")
    observations, _ = env.reset(seed=11)
    seen = [observations]
    for action in actions:
        seen.append(env.step(dict(zip(AGENTS, action, strict=True)))[0])
    return [np.concatenate([own[agent] for agent in AGENTS]) for own in seen]


def numbers_of_many(actions: np.ndarray) -> list[np.ndarray]:
    env = sm.parallel_env("reach", scene=SCENE, num_envs=1, max_steps=STEPS, engine="fused")
    observations, _ = env.reset(seed=11)
    seen = [observations]
    for action in actions:
        infos = env.step({a: action[None, i] for i, a in enumerate(AGENTS)})[-1]
        seen.append({agent: info["final_observation"] for agent, info in infos.items()})
    return [np.concatenate([own[agent][0] for agent in AGENTS]) for own in seen]


def numbers_of_turns(actions: np.ndarray) -> list[np.ndarray]:
    env = sm.reach_v0.env(scene=SCENE, max_steps=STEPS, engine="fused")
    env.reset(seed=11)
    seen = []
    for action in [*actions, None]:
        seen.append(np.concatenate([env.observe(agent) for agent in AGENTS]))
        for i in range(len(AGENTS)):
            env.step(None if action is None else action[i])
    return seen


def numbers_of_rsl_rl(actions: np.ndarray) -> list[np.ndarray]:
    env = RslRlVecEnv(batch("torch"), grouping="agent", seed=11)
    seen = [env.get_observations()]
    for action in actions:
        seen.append(env.step(torch.from_numpy(action).reshape(1, -1))[-1]["final_obs"])
    return [np.concatenate([own[agent][0, 0] for agent in AGENTS]) for own in seen]


def numbers_of_torchrl(actions: np.ndarray) -> list[np.ndarray]:
    pytest.importorskip("torchrl")
    from surgical_marl.interfaces.torchrl import TorchRLEnv

    env = TorchRLEnv(batch("torch"))
    env.set_seed(11)
    data, seen = env.reset(), []
    seen.append(data)
    for action in actions:
        data["psm", "action"] = torch.from_numpy(action)[None]
        stepped, data = env.step_and_maybe_reset(data)
        seen.append(stepped["next"])
    return [own["psm", "observation"].reshape(-1).numpy() for own in seen]


FACES: dict[str, Callable[[np.ndarray], list[np.ndarray]]] = {
    "torch": lambda actions: numbers_of_batch("torch", actions),
    "jax": lambda actions: numbers_of_batch("jax", actions),
    "parallel": numbers_of_parallel,
    "many": numbers_of_many,
    "turns": numbers_of_turns,
    "rsl_rl": numbers_of_rsl_rl,
    "torchrl": numbers_of_torchrl,
}


@pytest.mark.parametrize("face", FACES)
def test_one_seed_and_the_same_actions_give_the_same_numbers_through_every_face(face: str) -> None:
    actions = np.random.default_rng(1).uniform(-1, 1, (STEPS, len(AGENTS), WIDTH)).astype(np.float32)
    expected, found = numbers_of_batch("numpy", actions), FACES[face](actions)
    assert len(found) == STEPS + 1 and not np.array_equal(expected[0], expected[-1])
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("scene", ["psm", APART])
def test_rsl_rls_own_runner_trains_untouched(scene: str) -> None:
    batch = BatchedEnv("reach", scene, num_envs=8, max_steps=STEPS, arrays="torch", engine="fused")
    env = RslRlVecEnv(batch, seed=0)
    network = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu", "obs_normalization": True}
    noise = {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}}
    config = {
        "num_steps_per_env": 2 * STEPS,
        "save_interval": 10,
        "obs_groups": {"actor": ["state"], "critic": ["state"]},
        "actor": {**network, **noise},
        "critic": network,
        "algorithm": {"class_name": "PPO"},
    }
    runner = OnPolicyRunner(env, config, device=env.device)
    before = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
    runner.learn(3, init_at_random_ep_len=True)
    after = runner.alg.actor.state_dict()
    assert all(value.isfinite().all() for value in after.values())
    assert any(not torch.equal(value, before[name]) for name, value in after.items())
    env.close()
    with pytest.raises(ValueError, match="the environment is closed"):
        env.step(torch.zeros(8, env.num_actions))


@pytest.fixture
def own_garbage() -> Iterator[None]:
    """The garbage collector looks at the test's own objects alone: those of all tests before take it seconds."""
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("own_garbage")
@pytest.mark.parametrize(
    ("task", "scene", "options"),
    [("reach", "psm", {}), ("reach", "psm", {"num_envs": 128}), ("match_image", "ecm", {})],
)
@pytest.mark.parametrize("closes", [True, False])
def test_environments_leave_nothing_behind(task: str, scene: str, options: dict[str, Any], closes: bool) -> None:
    """Neither threads nor arrays, closed or only forgotten."""
    before, gone = threading.enumerate(), []
    for _ in range(3):
        env = sm.parallel_env(task, scene=scene, engine="fused", **options)
        env.reset(seed=0)
        env.step({a: np.zeros((*((128,) if options else ()), *env.action_space(a).shape)) for a in env.agents})
        gone.append(weakref.ref(env.batch.engine._arrays))
        if closes:
            env.close()
            gc.collect()
            assert gone[-1]() is None
    del env
    gc.collect()
    assert [reference() for reference in gone] == [None] * 3
    started = [thread for thread in threading.enumerate() if thread not in before]
    for thread in started:  # one that is on its way out may take a moment
        thread.join(10)
    assert not any(thread.is_alive() for thread in started)


@pytest.mark.usefixtures("own_garbage")
@pytest.mark.parametrize("face", ["parallel", "gymnasium", "gymnasium_vector", "rsl_rl"])
def test_a_closed_environment_is_freed_at_once(face: str) -> None:
    """It does not wait until Python looks for cycles among its objects, which on a GPU that is full may be too late."""

    def used() -> list[weakref.ref[Any]]:
        env: Any
        if face == "parallel":
            env = sm.parallel_env("reach", scene="psm", engine="fused", device="cpu")
        elif face == "rsl_rl":
            env = RslRlVecEnv(BatchedEnv("reach", "psm", engine="fused", device="cpu", arrays="torch"))
        else:
            made = gymnasium.make_vec if face == "gymnasium_vector" else gymnasium.make
            env = made("surgical_marl:surgical_marl/Reach-v0", scene="psm", engine="fused", device="cpu")
        if face == "rsl_rl":
            env.step(torch.zeros(1, env.num_actions))
        else:
            env.reset(seed=0)
            env.step(env.action_space.sample() if face != "parallel" else {"psm_0": np.zeros(7)})
        batch = env.env if face == "rsl_rl" else env.unwrapped.batch
        gone = [weakref.ref(part) for part in (batch, batch.env, batch.engine._arrays)]
        env.close()
        return gone

    gc.collect()
    gc.disable()
    try:
        for kept in (False, True):  # kernels of another environment of this process
            if not kept:
                kernel._made.cache_clear()
            assert [reference() for reference in used()] == [None] * 3, kept
    finally:
        gc.enable()


MANY = """
import ctypes, gc, os, sys, threading
import numpy as np
import surgical_marl as sm
task, scene, engine, count = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])
for number in range(1, count + 1):
    env = sm.parallel_env(task, scene=scene, engine=engine, device="cpu")
    env.reset(seed=number)
    env.step({agent: np.zeros(env.action_space(agent).shape) for agent in env.agents})
    env.close()
    if number in {count // 5, count * 3 // 5, count}:
        del env
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        with open("/proc/self/statm") as file:
            print(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20, threading.active_count())
"""
"""Prints the resident memory, MiB, and the threads: after a fifth, three fifths and all of the environments.

What the C library keeps of freed memory is given back first, so that only what is still held counts.
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("task", "scene", "engine", "count"),
    [("reach", "psm", "fused", 1000), ("match_image", "ecm", "fused", 1000), ("reach", "psm", "mjx", 50)],
)
def test_a_thousand_environments_leave_neither_memory_nor_threads(
    task: str, scene: str, engine: str, count: int
) -> None:
    def run(count: int) -> list[list[float]]:
        command = [sys.executable, "-c", MANY, task, scene, engine, str(count)]
        lines = subprocess.run(command, capture_output=True, check=True, text=True).stdout.splitlines()
        return [[float(word) for word in line.split()] for line in lines]

    run(5)  # to compile takes more memory than environments could leave
    (memory, *later), (threads, *afterwards) = zip(*run(count), strict=True)
    print(f"{task}, {scene}, {engine}: {memory:.1f} MiB after {count // 5} environments, then", *later, *afterwards)
    assert max(later) - memory < 5  # 6 kB an environment
    assert afterwards == [threads] * len(afterwards)


def test_without_torchrl_its_face_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchrl", None)
    monkeypatch.setitem(sys.modules, "torchrl.data", None)
    monkeypatch.delitem(sys.modules, "surgical_marl.interfaces.torchrl", raising=False)
    with pytest.raises(ImportError, match="the TorchRL face needs torchrl"):
        import_module("surgical_marl.interfaces.torchrl")
