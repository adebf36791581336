"""Prepare engines for timing: compile them, put them at the start of a course, and return their clocks."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from surgical_marl.bench.clock import Clock, cpu_clock, cuda_clock
from surgical_marl.bench.course import HOLD, LAPS, Course, tile
from surgical_marl.bench.other_simulators import RIVALS, Contender
from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.bench.workload import Workload
from surgical_marl.content import unknown
from surgical_marl.engines.choose import Engine, make_engine
from surgical_marl.engines.fused.env_sorting import control_steps
from surgical_marl.envs.batch import BatchedEnv

ENGINES = ("fused", "mjx", *RIVALS)


def prepare(engine: str, workload: Workload, course: Course) -> Contender:
    """Return the clocks of an engine that is compiled and stands at the start of a course.

    Raises:
        ValueError: an unknown engine, or one that can't run here.
        MemoryError: there is no room for so many environments.
    """
    if engine not in ENGINES:
        raise unknown("engine", engine, ENGINES)
    try:
        return RIVALS[engine](workload, course) if engine in RIVALS else _batched(engine, workload, course)
    except (ValueError, RuntimeError) as error:
        text = str(error)
        if any(sign in text.lower() for sign in ("no room", "out of memory", "resource_exhausted")):
            raise MemoryError(f"{engine} has no room for {workload.count} environments") from None
        raise


def _batched(name: str, workload: Workload, course: Course) -> Contender:
    """Prepare an engine of this package: a `BatchedEnv`, stepped as a user would, and its physics alone."""
    count, cuda = workload.count, workload.where == "cuda"
    library = "jax" if name == "mjx" else "torch" if cuda else "numpy"
    give = {"jax": _jax if cuda else np.asarray, "torch": _torch, "numpy": np.asarray}[library]
    actions = [{agent: give(tile(rows, count)) for agent, rows in lap.items()} for lap in course.actions]
    first = {part: give(tile(values, count)) for part, values in course.parts.items()}

    def begin(engine: Engine) -> None:
        for part, values in first.items():
            engine.write(part, values)

    start = time.perf_counter()
    batch = BatchedEnv(**workload.of_environment(), num_envs=count, engine=name, device=workload.where, arrays=library)
    batch.reset(seed=0)
    batch.step(actions[0])
    _wait(batch.engine)
    compile_s = time.perf_counter() - start
    begin(batch.engine)
    # otherwise all episodes would end in the same step
    batch.steps = give(np.random.default_rng(0).integers(0, batch.max_steps, count, dtype=np.int32))

    stride = math.gcd(HOLD, workload.decimation)
    physics = make_engine(PhysicsAlone(batch.env, stride), count, name, workload.where)
    physics.reset(0)
    begin(physics)
    step_physics = _along(physics, [give(tile(rows, count)) for rows in course.commands], HOLD // stride)
    hold = max(1, HOLD // workload.decimation)
    step_env = _through(batch, actions, hold)
    lap = HOLD // stride * LAPS
    cycles = _cycle(lap, stride), _cycle(hold * LAPS, workload.decimation)
    if workload.motion == "grasp":  # new episodes have nothing in their jaws
        step_env = _beginning(step_env, partial(begin, batch.engine), cycles[1])
    if workload.motion == "policy":  # what a policy does is not to and fro
        step_physics = _beginning(step_physics, partial(begin, physics), lap)
        step_env = _beginning(step_env, partial(begin, batch.engine), hold * LAPS)
    step_physics()  # compiles
    _wait(physics)
    clocks = _clock(step_physics, physics, cycles[0]), _clock(step_env, batch.engine, cycles[1])
    return Contender(count, workload.where, compile_s, *clocks, stride, _bytes_per_env(batch.engine))


def clock_of(batch: BatchedEnv, actions: list[Any], begin: Callable[[], None] | None = None) -> Clock:
    """Return the clock of a batch that is stepped by some actions in turn.

    `begin` puts its environments back to their starts before every cycle. Where jaws hold objects it is needed: new
    episodes have nothing in them.
    """
    step, cycle = _through(batch, actions), _cycle(len(actions), batch.env.decimation)
    return _clock(_beginning(step, begin, cycle) if begin else step, batch.engine, cycle)


def _beginning(step: Callable[[], None], begin: Callable[[], None], every: int) -> Callable[[], None]:
    """Return a step that puts environments back to their starts before every `every`-th call."""
    turn = itertools.count()

    def begun() -> None:
        if next(turn) % every == 0:
            begin()
        step()

    return begun


def _clock(step: Callable[[], None], engine: Engine, cycle: int) -> Clock:
    """Return the clock of a step, whose work repeats after `cycle` calls."""
    if engine.device == "cuda" and engine.name == "fused":
        return cuda_clock(step, cycle)
    return cpu_clock(step, lambda: _wait(engine))


def _cycle(lap: int, decimation: int) -> int:
    """Return the calls after which laps end and environments were sorted as often as in a long run."""
    return math.lcm(lap, control_steps(decimation))


def _through(batch: BatchedEnv, actions: list[Any], hold: int = 1) -> Callable[[], None]:
    """Return a function that steps a batch by some actions in turn, each for `hold` steps."""
    turn = itertools.count()

    def step() -> None:
        batch.step(actions[next(turn) // hold % len(actions)])

    return step


def _along(physics: Engine, commands: list[Any], hold: int = HOLD) -> Callable[[], None]:
    """Return a function that steps physics under the commands of a course, each of them for `hold` steps."""
    turn = itertools.count()

    def step() -> None:
        now = next(turn)
        if now % hold == 0:
            physics.write(".physics.arms.ctrl", commands[now // hold % LAPS])
        physics.step({})

    return step


def _wait(engine: Engine) -> None:
    engine.read(".physics.arms.qpos", "numpy")


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
