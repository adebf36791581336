"""Engines, ready to be timed."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from surgical_marl.bench.clock import Clock, cpu_clock, cuda_clock
from surgical_marl.bench.course import HOLD, LAPS, Course, full_state, tile, with_objects
from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.bench.workload import Workload
from surgical_marl.content import unknown
from surgical_marl.engines.choose import Engine, make_engine
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.machine import cores
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.mjcf import mjcf

ENGINES = ("fused", "mjx", "mujoco")
MOST_ROLLED = 4096
"""Environments for which C MuJoCo gets memory. It steps environments one after the other on each core, so more don't
make it faster."""


@dataclass(frozen=True)
class Contender:
    """Clocks of an engine."""

    num_envs: int
    device: str
    compile_s: float
    """Time from imported packages to the end of the first step, s."""
    physics: Clock
    env: Clock | None
    """Clock of environment steps; C MuJoCo has none."""
    stride: int = 1
    """Physics steps that the clock of physics counts as one."""
    bytes_per_env: int | None = None
    """Bytes of the arrays of the fused engine's kernel."""


def prepare(engine: str, workload: Workload, course: Course) -> Contender:
    """Return the clocks of an engine that is compiled and stands at the start of a course.

    Raises:
        ValueError: an unknown engine, or one that can't run here.
        MemoryError: there is no room for so many environments.
    """
    if engine not in ENGINES:
        raise unknown("engine", engine, ENGINES)
    try:
        return _mujoco(workload, course) if engine == "mujoco" else _batched(engine, workload, course)
    except (ValueError, RuntimeError) as error:
        text = str(error)
        if any(sign in text.lower() for sign in ("no room", "out of memory", "resource_exhausted")):
            raise MemoryError(f"{engine} has no room for {workload.count} environments") from None
        raise


def _batched(name: str, workload: Workload, course: Course) -> Contender:
    """One of this package's engines: a `BatchedEnv`, as a user would step it, and its physics alone."""
    count, cuda = workload.count, workload.where == "cuda"
    library = "jax" if name == "mjx" else "torch" if cuda else "numpy"
    give = {"jax": _jax if cuda else np.asarray, "torch": _torch, "numpy": np.asarray}[library]
    actions = [{agent: give(tile(rows, count)) for agent, rows in lap.items()} for lap in course.actions]

    start = time.perf_counter()
    batch = BatchedEnv(**workload.of_environment(), num_envs=count, engine=name, device=workload.where, arrays=library)
    batch.reset(seed=0)
    batch.step(actions[0])
    _wait(batch.engine)
    compile_s = time.perf_counter() - start
    # otherwise all episodes would end in the same step
    batch.steps = give(np.random.default_rng(0).integers(0, batch.max_steps, count, dtype=np.int32))

    hold, turn = max(1, HOLD // workload.decimation), itertools.count()

    def step_env() -> None:
        batch.step(actions[next(turn) // hold % LAPS])

    physics = make_engine(PhysicsAlone(batch.env), count, name, workload.where)
    physics.reset(0)
    physics.write(".physics.qpos", give(tile(course.qpos, count)))
    physics.write(".physics.qvel", give(tile(course.qvel, count)))
    for part, values in course.parts.items():
        physics.write(f".physics.objects{part}", give(tile(values, count)))
    step_physics = _along(physics, [give(tile(rows, count)) for rows in course.commands])
    step_physics()  # compiles
    _wait(physics)
    if cuda and name == "fused":
        clocks = cuda_clock(step_physics, HOLD * LAPS), cuda_clock(step_env, hold * LAPS)
    else:
        clocks = cpu_clock(step_physics, lambda: _wait(physics)), cpu_clock(step_env, lambda: _wait(batch.engine))
    return Contender(count, workload.where, compile_s, *clocks, bytes_per_env=_bytes_per_env(batch.engine))


def _along(physics: Engine, commands: list[Any]) -> Callable[[], None]:
    """Return a function that makes a physics step under the commands of a course, one step further at each call."""
    turn = itertools.count()

    def step() -> None:
        now = next(turn)
        if now % HOLD == 0:
            physics.write(".physics.ctrl", commands[now // HOLD % LAPS])
        physics.step({})

    return step


def _mujoco(workload: Workload, course: Course) -> Contender:
    """C MuJoCo's own way to step many: `mujoco.rollout`, with a thread on every core."""
    count, threads = min(workload.count, MOST_ROLLED), cores()
    start = time.perf_counter()
    scene = load_scene(workload.scene, workload.control)
    model = mujoco.MjModel.from_xml_string(mjcf(scene)) if scene.objects else scene.model
    qpos, qvel = with_objects(scene, course) if scene.objects else (course.qpos, course.qvel)
    state = full_state(tile(qpos, count), tile(qvel, count))
    control = tile(course.commands.astype(float).repeat(HOLD, 0).swapaxes(0, 1), count)
    data, pool = [mujoco.MjData(model) for _ in range(threads)], rollout.Rollout(nthread=threads)
    pool.rollout(model, data, state[:1], control[:1, :1])
    compile_s = time.perf_counter() - start
    out = np.empty((count, HOLD * LAPS, state.shape[1]))

    def lap() -> None:
        pool.rollout(model, data, state, control, state=out)

    return Contender(count, "cpu", compile_s, cpu_clock(lap), None, stride=HOLD * LAPS)


def _wait(engine: Engine) -> None:
    engine.read(".physics.qpos", "numpy")


def _torch(values: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(values).cuda()


def _jax(values: np.ndarray) -> Any:
    import jax

    return jax.numpy.asarray(values)


def _bytes_per_env(engine: Any) -> int | None:
    if engine.name != "fused":
        return None
    return sum(fields * (1 if name == "flags" else 4) for name, fields in engine.source.sizes.items())
