"""Prepare other simulators for timing: C MuJoCo and MuJoCo Warp, on the scene as `export scene` writes it.

Without objects that is `Scene.model` itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from surgical_marl.bench.clock import Clock, cpu_clock
from surgical_marl.bench.course import HOLD, LAPS, Course, full_state, tile, with_objects
from surgical_marl.bench.workload import Workload
from surgical_marl.control.controller import actuators_of
from surgical_marl.machine import cores
from surgical_marl.runtime import prepare_mjx, prepare_warp
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.mjcf import mjcf

MOST_ROLLED = 4096
"""Environments for which C MuJoCo gets memory. It steps environments one after the other on each core, so more don't
make it faster."""
SPARE = 1.25
"""Rows of constraints that MuJoCo Warp gets in each environment, as a share of the most that C MuJoCo needs."""


@dataclass(frozen=True)
class Contender:
    """Clocks of an engine."""

    num_envs: int
    device: str
    compile_s: float
    """Time from imported packages to the end of the first step, s."""
    physics: Clock
    env: Clock | None
    """Clock of environment steps; other simulators have none."""
    stride: int = 1
    """Physics steps that the clock of physics counts as one."""
    bytes_per_env: int | None = None
    """Bytes of the arrays of the fused engine's kernel."""


def c_mujoco(workload: Workload, course: Course) -> Contender:
    """Return C MuJoCo with its own way to step many: `mujoco.rollout`, with a thread on every core."""
    count, threads = min(workload.count, MOST_ROLLED), cores()
    start = time.perf_counter()
    model, states = _exported(workload, course)
    state, control = tile(states, count), tile(_controls(course), count)
    data, pool = [mujoco.MjData(model) for _ in range(threads)], rollout.Rollout(nthread=threads)
    pool.rollout(model, data, state[:1], control[:1, :1])
    compile_s = time.perf_counter() - start
    out = np.empty((count, HOLD * LAPS, state.shape[1]))

    def lap() -> None:
        pool.rollout(model, data, state, control, state=out)

    return Contender(count, "cpu", compile_s, cpu_clock(lap), None, stride=HOLD * LAPS)


def mujoco_warp(workload: Workload, course: Course) -> Contender:
    """Return MuJoCo Warp, which comes with MJX; on a GPU a step is a CUDA graph, as in its own benchmark.

    Raises:
        ValueError: after a lap its state is not finite.
    """
    start = time.perf_counter()
    prepare_mjx()
    wp = prepare_warp()
    model, states = _exported(workload, course)
    contacts, rows = _most(model, states, _controls(course))
    with wp.ScopedDevice(workload.where):
        while True:
            lap, step, data, short = _warp_lap(wp, workload, course, model, states, contacts, rows)
            if not short:
                break
            contacts, rows = 2 * contacts, 2 * rows
        if not np.isfinite(data.qpos.numpy()).all():
            raise ValueError(f"MuJoCo Warp: after a lap on scene {workload.scene!r} the state is not finite")
        replay = step
        if workload.where == "cuda":
            with wp.ScopedCapture() as capture:
                step()
            replay = partial(wp.capture_launch, capture.graph)
    compile_s = time.perf_counter() - start

    def run() -> None:
        with wp.ScopedDevice(workload.where):
            lap(replay)

    return Contender(workload.count, workload.where, compile_s, cpu_clock(run, wp.synchronize), None, HOLD * LAPS)


RIVALS: dict[str, Callable[[Workload, Course], Contender]] = {"mujoco": c_mujoco, "mujoco_warp": mujoco_warp}
"""Functions that prepare another simulator, by the name that `--engine` takes."""


def _exported(workload: Workload, course: Course) -> tuple[mujoco.MjModel, np.ndarray]:
    """Return the model of a workload's scene, and the states [n, 1 + nq + nv] at the start of a course."""
    scene = load_scene(workload.scene, actuators_of(workload.control))
    if not scene.objects:
        return scene.model, full_state(course.qpos, course.qvel)
    return mujoco.MjModel.from_xml_string(mjcf(scene)), full_state(*with_objects(scene, course))


def _controls(course: Course) -> np.ndarray:
    """Return the commands of every physics step of a lap, [n, HOLD * LAPS, nu]."""
    return course.commands.astype(float).repeat(HOLD, 0).swapaxes(0, 1)


def _most(model: mujoco.MjModel, states: np.ndarray, controls: np.ndarray) -> tuple[int, int]:
    """Return the most contacts and rows of constraints in C MuJoCo while it steps along a lap."""
    data, most = mujoco.MjData(model), np.zeros(2, int)
    for state, control in zip(states, controls, strict=True):
        mujoco.mj_resetData(model, data)
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for data.ctrl[:] in control:
            mujoco.mj_step(model, data)
            most = np.maximum(most, (data.ncon, data.nefc))
    return int(most[0]), int(most[1])


def _warp_lap(
    wp: ModuleType,
    workload: Workload,
    course: Course,
    model: mujoco.MjModel,
    states: np.ndarray,
    contacts: int,
    rows: int,
) -> tuple[Callable[[Callable[[], None]], None], Callable[[], None], Any, bool]:
    """Return functions for a lap and for a step, the data after a lap, and whether it lacked room."""
    from mujoco.mjx.third_party import mujoco_warp as library

    count, nq = workload.count, model.nq
    warped = library.put_model(model)
    warped.opt.warn_overflow = 0
    data = library.make_data(model, count, nconmax=2 * contacts + 8, njmax=int(SPARE * rows) + 8)
    data.qpos.assign(tile(states[:, 1 : 1 + nq], count).astype(np.float32))
    data.qvel.assign(tile(states[:, 1 + nq :], count).astype(np.float32))
    commands = [wp.array(tile(each, count).astype(np.float32), dtype=float) for each in course.commands]

    def step() -> None:
        library.step(warped, data)

    def lap(step: Callable[[], None]) -> None:
        for command in commands:
            wp.copy(data.ctrl, command)
            for _ in range(HOLD):
                step()

    lap(step)
    kinds = library.OverflowType
    full = kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE
    return lap, step, data, bool((data.overflow.numpy() & int(full)).any())
