"""The fused engine against the MJX engine: the same step, one kernel instead of some hundred."""

from __future__ import annotations

import gc
import re
import shutil
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from surgical_marl.bench.starts import grasps
from surgical_marl.content import list_scenes
from surgical_marl.engines.choose import make_engine
from surgical_marl.engines.fused.engine import FusedEngine, flatten
from surgical_marl.engines.fused.source_cache import load_source
from surgical_marl.engines.fused.threefry import episode_keys
from surgical_marl.engines.mjx import MjxEngine
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.robots.arm import load_arm
from surgical_marl.robots.drives import CONTROL_MODES
from surgical_marl.tasks.base.path_task import PathTask
from surgical_marl.tasks.base.paths import DURATION
from tests.helpers.fused_kernels import gpu_code
from tests.helpers.object_parity import Beside

STATES = 1024
TOLERANCE = 1e-5
ULPS = 10
"""How many times what a change of the state by one unit in the last place makes, where that is more."""

# XLA takes 12 s to compile the reference for a small scene and a minute for a large one. `make test` takes one of each
# kind: arms that touch, each way of control, goals at rest and paths. `pytest -m slow` takes all others. Until then the
# star's acceleration is compared with C MuJoCo's in test_solver, every primitive with JAX's in test_primitives.
PLAYED = [(task, scene) for task in list_tasks() for scene in TASKS.load(task).scenes or list_scenes()]
ALL = [(task, scene, control) for task, scene in PLAYED for control in CONTROL_MODES]
QUICK = [("bimanual_psm", "position"), ("ecm", "velocity"), ("ecm", "torque")]
CASES = [
    case
    if (case[1:] in QUICK and case[0] == "reach") or case == ("follow_path", "psm", "position")
    else pytest.param(*case, marks=pytest.mark.slow)
    for case in ALL
]


def random_state(env: Env, seed: int = 0) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Parts of the carry and actions: joints up to 5 % of their range beyond their limits, some arms in each other,
    any speed and command, time-outs among them."""
    model, rng = env.scene.model, np.random.default_rng(seed)
    low, high = model.jnt_range.T
    slack = 0.05 * (high - low)
    fastest = np.concatenate([[joint.velocity for joint in m.arm.joints] for m in env.scene.mounts.values()])
    carry = {
        ".physics.arms.qpos": rng.uniform(low - slack, high + slack, (STATES, model.nq)),
        ".physics.arms.qvel": rng.uniform(-fastest, fastest, (STATES, model.nv)),
        ".physics.arms.qacc_warmstart": rng.normal(0, 10, (STATES, model.nv)),
        ".physics.arms.ctrl": rng.uniform(*model.actuator_ctrlrange.T, (STATES, model.nu)),
        ".episode": rng.integers(0, 1000, STATES),
        ".steps": rng.integers(0, env.max_steps, STATES),
    }
    if isinstance(env.task, PathTask):
        carry[".goal.time"] = rng.uniform(0, 1.2 * DURATION, STATES)
    actions = {agent: rng.uniform(-1, 1, (STATES, env.num_actions(agent))) for agent in env.agents}
    single = lambda x: x.astype(np.int32 if x.dtype.kind == "i" else np.float32)  # noqa: E731
    return {name: single(x) for name, x in carry.items()}, {agent: single(x) for agent, x in actions.items()}


def play(engine: Any, carry: dict[str, np.ndarray], actions: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """All that a step from these states leads to, by name."""
    engine.reset(3)
    for name, value in carry.items():
        engine.write(name, value)
    senses = {name: np.linspace(0, 9, STATES, dtype=np.float32) for name in engine.env.task.senses}
    engine.step(actions, lambda: senses)
    found = flatten(engine.outcome("numpy")) | {name: engine.read(name, "numpy") for name in engine.carry_shapes}
    return {name: np.array(value).reshape(STATES, -1) for name, value in found.items()}


def off(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The largest difference of each environment, as a share of the largest value of each column."""
    scale = np.maximum(np.abs(np.where(np.isfinite(one), one, 0)).max(0, initial=0), 1e-6)
    with np.errstate(invalid="ignore"):
        return np.where(one == other, 0, np.abs(one - other) / scale).max(1, initial=0)


@pytest.mark.parametrize(("task", "scene", "control"), CASES)
def test_a_step_is_the_mjx_engines(task: str, scene: str, control: str) -> None:
    """Numbers to 1e-5 of their scale; flags, counters and random goals exactly. Overlapping arms are stiff, and so are
    violated limits: where the state's last digit alone makes more of a difference, the engines may differ so too. Two
    states of 1,024 an arm or free object may differ more: what is rounded within a step can count for more than the
    state's digits."""
    env = Env(task, scene, control=control, decimation=1)
    carry, actions = random_state(env)
    mjx = MjxEngine(env, STATES, "cpu")
    expected, found = play(mjx, carry, actions), play(FusedEngine(env, STATES, "cpu"), carry, actions)
    qpos = carry[".physics.arms.qpos"]
    moved = [play(mjx, carry | {".physics.arms.qpos": np.nextafter(qpos, np.float32(way))}, actions) for way in (-9, 9)]
    assert expected.keys() == found.keys()
    touching = expected[".contacts.penetration"].max(1, initial=0) > 0
    if len(env.agents) > 1:
        assert touching.sum() >= 5
    bodies = len(env.agents) + len(env.scene.free_objects)
    for agent in env.agents:  # and by objects and fixed things
        touching |= expected[f".infos.{agent}.contact_force"][:, 0] > 0
    for name, value in expected.items():
        if value.dtype.kind == "f":
            worst = off(value, found[name])
            allowed = np.maximum(TOLERANCE, ULPS * np.maximum(*(off(value, other[name]) for other in moved)))
            assert (worst <= allowed).mean() >= 1 - 2 * bodies / STATES, (name, np.sort(worst / allowed)[-5:])
            if name.startswith(".physics"):
                assert np.percentile(worst[~touching], 99.8) < TOLERANCE, name
        else:
            np.testing.assert_array_equal(value, found[name], name)
    assert found[".truncated"].any() and not found[".truncated"].all()


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["psm", "bimanual_psm"])
def test_episodes_stay_as_near_as_a_changed_last_digit(scene: str) -> None:
    """Over 200 control steps the engines part no more than MJX parts from itself when the first state changes by one
    unit in the last place: the median and the 99th percentile of environments, at the end and at the worst moment."""
    env, count = Env("reach", scene, max_steps=1000), 128

    def episode(engine: Any, ulps: int) -> np.ndarray:
        rng = np.random.default_rng(0)
        engine.reset(0)
        for _ in range(ulps):
            engine.write(".physics.arms.qpos", np.nextafter(engine.read(".physics.arms.qpos", "numpy"), np.float32(9)))
        path = []
        for step in range(200):
            if step % 10 == 0:
                hold = {a: rng.uniform(-1, 1, (count, env.num_actions(a))).astype(np.float32) for a in env.agents}
            engine.step(hold)
            path.append(engine.read(".physics.arms.qpos", "numpy"))
        return np.array(path)

    mjx = MjxEngine(env, count, "cpu")
    paths = [episode(mjx, 0), episode(mjx, 1), episode(FusedEngine(env, count, "cpu"), 0)]
    itself, fused = (np.abs(path - paths[0]).max((0, 2)) for path in paths[1:])
    for share in (50, 99):
        assert np.percentile(fused, share) <= 10 * np.percentile(itself, share) + 1e-6, share
    assert fused.max() < 1e-2


@pytest.mark.parametrize("seed", [0, 1, 12345, 2**31, 2**32 + 5, 2**63 - 1])
def test_keys_are_those_of_jax(seed: int) -> None:
    with jax.enable_x64(True):  # without it JAX drops the upper 32 bits of a seed
        key = jax.random.PRNGKey(seed)
    expected = jax.vmap(jax.random.fold_in, (None, 0))(key, np.arange(100))
    np.testing.assert_array_equal(episode_keys(seed, 100), expected)


def test_an_environment_does_not_depend_on_the_others() -> None:
    """Whatever their number: neither on the vector it is in, nor on the thread."""
    env = Env("reach", "psm")
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1, 1, (100, 7)).astype(np.float32) for _ in range(5)]
    found = []
    for count in (100, 3):
        engine = FusedEngine(env, count, "cpu")
        engine.reset(0)
        for action in actions:
            engine.step({"psm_0": action[:count]})
        found.append(engine.read(".physics.arms.qpos", "numpy")[:3])
    np.testing.assert_array_equal(*found)


def test_what_was_read_stays() -> None:
    """Arrays of one step are not overwritten by the next."""
    for arrays in ("numpy", "torch", "jax"):
        env = BatchedEnv("reach", "psm", num_envs=3, arrays=arrays, engine="fused")
        env.reset(seed=0)
        action = {"psm_0": np.ones((3, 7), np.float32)}
        step = env.step(action)
        before = np.asarray(step.observations["psm_0"]).copy()
        env.step(action)
        np.testing.assert_array_equal(before, np.asarray(step.observations["psm_0"]))


@pytest.mark.parametrize("arrays", ["numpy", "torch", "jax"])
def test_a_step_leaves_nothing_to_collect(arrays: str) -> None:
    """What a step returned is free as soon as nobody holds it: a batch may take half of a GPU, and nothing is collected
    while a CUDA graph is captured."""
    env = BatchedEnv("reach", "psm", num_envs=3, engine="fused", device="cpu", arrays=arrays)
    actions = {agent: np.zeros((3, *env.action_space(agent).shape), np.float32) for agent in env.agents}
    env.reset(seed=0)
    env.step(actions)
    gc.collect()
    gc.disable()
    try:
        for _ in range(3):
            env.step(actions)
        assert gc.collect() == 0
    finally:
        gc.enable()


class Sorting(Env):
    """Sorts numbers in a step, which the fused engine has no code for."""

    def step(self, carry: Any, actions: dict[str, Any], parameters: Any = None) -> Any:
        state = super().step(carry, actions, parameters)
        return state._replace(terminated=state.terminated | (jax.lax.sort(carry.goal.targets[0])[0] > 9))


def test_what_it_cannot_take_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """With the line that uses it; `auto` then runs MJX, and says so."""
    env = Sorting("reach", "ecm")
    with pytest.raises(ValueError, match=r"engine 'fused' can't run reach on ecm: .*sort.*test_engine\.py:\d+"):
        make_engine(env, 1, "fused", "cpu")
    assert make_engine(env, 1, "auto", "cpu").name == "mjx"
    assert "engine mjx instead of fused: reach on ecm uses" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 10**11}, r"num_envs 100000000000 does not fit into memory: .* so that \d+ fit"),
        ({"device": "tpu"}, "unknown device 'tpu'"),
        ({"decimation": 0}, "decimation must be a whole number from 1 to 1,000,000, not 0"),
    ],
)
def test_bad_input(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BatchedEnv("reach", "psm", engine="fused", **options)


def test_another_mass_is_another_program(tmp_path: Path) -> None:
    """An arm edited in a number that shapes and joints don't show is not taken for what it was."""

    def program(mass: float) -> str:
        folder = tmp_path / str(mass) / "ecm"
        shutil.copytree(load_arm("ecm").folder, folder)
        urdf = folder / "ecm.urdf"
        text = urdf.read_text()
        value = re.search(r'<mass value="([^"]+)"', text)
        assert value is not None
        urdf.write_text(text.replace(value[0], f'<mass value="{float(value[1]) + mass}"', 1))
        scene = folder.with_suffix(".yaml")
        scene.write_text("arms: {ecm_0: {arm: ecm, workspace: [0, 0, -0.1]}}")
        return load_source(Env("reach", str(scene)), vector=True).bodies["step"]

    assert program(0.0005) != program(0.0006)


START = """
import logging
logging.basicConfig()
logging.getLogger("surgical_marl").setLevel("INFO")
from surgical_marl.envs.batch import BatchedEnv
env = BatchedEnv("reach", "ecm", num_envs=2, engine="fused", device="cpu")
print(float(env.reset(seed=0)[1].sum()))
"""


def test_caches_may_be_shared_and_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes that start at once, of which one traces, and the same or the other compiles, then one that finds
    every file of the caches cut short: all agree. What a process still compiles is left to it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "warp"))

    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", START], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def finish(process: subprocess.Popen[str]) -> tuple[str, str]:
        out, err = process.communicate()
        assert process.returncode == 0, err
        return out, err

    first = [finish(process) for process in [start(), start()]]
    again = finish(start())
    for stage in ("tracing the step", "compiling the C code"):
        assert sum(err.count(stage) for _, err in first) == 1
    assert "compiling" not in again[1]
    damaged = [*(tmp_path / "warp").rglob("*.o"), *(tmp_path / "cache" / "surgical-marl" / "fused").glob("*.npz")]
    assert len(damaged) == 2
    (folder,) = {file.parent for file in damaged if file.suffix == ".o"}
    unfinished = folder.with_name(f"{folder.name}_p1_t1")
    unfinished.mkdir()
    for file in damaged:
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert {out for out, _ in (*first, again, finish(start()))} == {again[0]}
    assert unfinished.is_dir()


@pytest.mark.parametrize("library", ["numpy", "torch", "jax"])
def test_later_steps_leave_results_as_they_are(library: str) -> None:
    """Also where only a part of what a step returned is held, such as one agent's reward."""
    env = BatchedEnv("reach", "psm", num_envs=8, engine="fused", device="cpu", arrays=library)
    env.reset(0)
    rng, held = np.random.default_rng(0), []
    for _ in range(8):
        step = env.step({"psm_0": rng.uniform(-1, 1, (8, 7))})
        held += [(part, np.asarray(part).copy()) for part in (step.rewards["psm_0"], step.state[2:5], step.terminated)]
        if len(held) > 12:
            del held[3:9]  # so that some memory becomes free, and some does not
        del step
        for part, value in held:
            np.testing.assert_array_equal(np.asarray(part), value)


def test_results_that_are_equal_are_written_once() -> None:
    """Also those of the next episode: one arm's observation is the whole state."""
    results = FusedEngine(Env("reach", "psm"), 1, "cpu").source.results
    assert results["state"] == results["observations"]["psm_0"]
    assert results["final_state"] == results["final_observations"]["psm_0"]


def test_a_step_on_a_cpu_takes_no_new_memory() -> None:
    env = BatchedEnv("reach", "bimanual_psm", num_envs=1024, engine="fused", device="cpu")
    env.reset(0)
    actions = {agent: np.zeros((1024, 7), np.float32) for agent in env.agents}
    step = [env.step(actions) for _ in range(2)][-1]
    tracemalloc.start()
    for _ in range(3):
        step = env.step(actions)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < step.state.nbytes  # of 1.3 MB of results


COUNT, STEPS, EVERY = 16, 40, 8
LARGER = "bimanual_psm_needle", "bimanual_psm_pegs", "trimanual_psm_ecm_needle", "trimanual_psm_ecm_pegs"


@pytest.mark.parametrize("name", ["psm_needle", *(pytest.param(name, marks=pytest.mark.slow) for name in LARGER)])
def test_a_step_with_objects_is_that_of_the_reference(name: str) -> None:
    follow_grasps(Beside(name, COUNT))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["psm_needle", "bimanual_psm_needle"])
def test_the_code_for_a_gpu_makes_the_same_step(name: str) -> None:
    with gpu_code():
        follow_grasps(Beside(name, COUNT))


def follow_grasps(both: Beside) -> None:
    """Close jaws on objects, and compare both engines on the way."""
    simulator, starts = both.simulator, grasps(both.env.scene, COUNT, np.random.default_rng(0))
    qpos, position, quaternion = (x.astype(np.float32) for x in starts[:3])
    now = jax.vmap(simulator.at)(qpos)
    bodies = now.rigid_bodies.bodies._replace(position=position, quaternion=quaternion)
    closed = np.array(simulator.home.ctrl)
    now = now.with_systems(rigid_bodies=now.rigid_bodies._replace(bodies=bodies))
    now = now.with_arms(ctrl=np.where(closed > 0, closed, now.ctrl))
    now = now.with_arms(ctrl=np.array(now.ctrl) - 0.03)  # jaws close, and wrists move
    held = 0.0
    for k in range(STEPS):
        # Nothing is known of accelerations in the first step: one state of 16 takes all Newton steps that there may be,
        # and how near that comes depends on rounding.
        now = both.step(now, compared=k % EVERY == EVERY - 1)
        held = max(held, float(now.rigid_bodies.grips.force.max()))
    assert held > 1.0
